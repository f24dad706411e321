"""Sensor workers give the same bytes for any number and placement, even if workers die."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl import CavVectorEnv, make_vec
from cavmarl.core.errors import ConfigError, EpisodeError, WorkerError
from cavmarl.parallel.sensor_workers import sensor_pool as sensor_farm
from cavmarl.parallel.sensor_workers import sensor_shares
from cavmarl.parallel.sensor_workers.line_costs import LineCosts
from cavmarl.parallel.sensor_workers.sensor_pool import SensorWorkers
from cavmarl.parallel.sensor_workers.sensor_shares import Shares
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.sensors.mounted.sensor_rig import Turn

RIG: dict[str, dict[str, Any]] = {
    "lidar": {"type": "lidar", "rate_hz": 10, "rays": 24, "layers": 2, "z_m": 1.6, "noise": [0.02]},
    "radar": {"type": "radar", "rate_hz": 20, "x_m": 2.5, "z_m": 0.5},
    "rgb": {"type": "rgb_camera", "rate_hz": 10, "z_m": 1.5, "width": 24, "height": 16},
    "depth": {"type": "depth_camera", "rate_hz": 5, "z_m": 1.5, "width": 24, "height": 16},
    "classes": {"type": "semantic_camera", "rate_hz": 10, "z_m": 1.5, "width": 24, "height": 16},
    "seen": {"type": "bev_grid", "rate_hz": 10},
    "gnss": {"type": "gnss", "rate_hz": 4, "phase_ticks": 2, "noise": [0.5], "dropout": 0.3},
    "imu": {"type": "imu", "rate_hz": 100, "noise": [0.02], "bias": [0.05]},
    "wheels": {"type": "odometry", "rate_hz": 3, "schedule": "accumulate"},
    "lane": {"type": "lane_boundary", "rate_hz": 20, "noise": [0.03]},
    "bumps": {"type": "collision", "dropout": 0.1},
}
SMALL: dict[str, dict[str, Any]] = {
    "wheels": {"type": "odometry", "rate_hz": 20, "noise": [0.1]},
    "imu": {"type": "imu", "rate_hz": 100},
}
STEPS = 12


@pytest.fixture(autouse=True)
def _crowded() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*sensor workers: there are", append=False)
        yield


def _make(rig: dict[str, dict[str, Any]] = RIG, **keywords: Any) -> CavVectorEnv:
    overrides = {"rig": rig, "population.mode": "respawn", **keywords.pop("overrides", {})}
    agents = keywords.pop("num_agents", 6)
    return make_vec("grid4x4", agents=agents, background=30, overrides=overrides, **keywords)


def _results(vec: CavVectorEnv) -> list[bytes | str]:
    arrays = [array.tobytes() for frames in vec.frames().values() for array in frames]
    return [*arrays, *(vec.state_hash(w) for w in range(vec.num_envs))]


def _drive(steps: int = STEPS, **keywords: Any) -> list[list[bytes | str]]:
    """Return the frames and state hashes after the reset and after each step."""
    vec = _make(**keywords)
    try:
        vec.reset(seed=7)
        seen = [_results(vec)]
        for _ in range(steps):
            vec.step(vec.suggest_actions())
            seen.append(_results(vec))
    finally:
        vec.close()
    return seen


@pytest.fixture(scope="module")
def alone() -> list[list[bytes | str]]:
    """Return the results without sensor workers."""
    return _drive()


def _sensor_workers(vec: CavVectorEnv) -> SensorWorkers:
    assert isinstance(vec.worlds, LocalWorlds)
    assert vec.worlds.sensor_workers is not None
    return vec.worlds.sensor_workers


def _pids(vec: CavVectorEnv) -> list[int]:
    pool = _sensor_workers(vec).pool
    assert pool is not None
    return [pool.server_pid, *pool.pids]


def _gone(pids: list[int], limit_s: float = 10.0) -> bool:
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        if not any(Path(f"/proc/{pid}").exists() for pid in pids):
            return True
        time.sleep(0.01)
    return False


@pytest.mark.parametrize("sensor_workers", [1, 2, 3])
@pytest.mark.parametrize("placement", ["cost", "in_turn"])
def test_results_do_not_depend_on_the_number_of_workers_or_their_shares(
    alone: list[list[bytes | str]], sensor_workers: int, placement: str
) -> None:
    settings = {"workers.sensor_placement": placement}
    assert _drive(sensor_workers=sensor_workers, overrides=settings) == alone


@pytest.mark.parametrize("sensor_workers", [2, 3])
@pytest.mark.parametrize("agents", [1, 6])
def test_results_do_not_depend_on_the_division_of_frames(
    monkeypatch: pytest.MonkeyPatch, agents: int, sensor_workers: int
) -> None:
    """Force the division of small frames, which would otherwise stay undivided.

    The test sets the costs of frames, because measured costs depend on the machine. In each
    division, another frame is so expensive that all workers must write parts of it.
    """
    divided, turn = set[int](), count()

    def divide(shares: Shares, _: LineCosts) -> Shares:
        lines = {unit.sensor: unit.end for unit in shares.units}
        fine = [number for number, unit in enumerate(shares.units) if unit.end >= 8]
        if not fine:
            return shares
        dear = fine[next(turn) * 7 % len(fine)]
        costs_s = tuple(float(number == dear) for number in range(len(shares.units)))
        even = LineCosts([lines.get(sensor, 1) for sensor in range(len(RIG))])
        found = sensor_shares.divide(replace(shares, costs_s=costs_s), even)
        assert len(found.units) == len(shares.units) + sensor_workers - 1
        divided.add(shares.units[dear].sensor)
        return found

    monkeypatch.setattr(sensor_farm, "divide", divide)
    frames = _drive(sensor_workers=sensor_workers, num_agents=agents)
    assert len(divided) > 1
    assert frames == _drive(num_agents=agents)


@pytest.mark.parametrize("zones", [2, 4, 9])
def test_zones_with_and_without_sensor_workers_give_the_results_of_one_world(
    alone: list[list[bytes | str]], zones: int
) -> None:
    assert _drive(zones=zones) == alone
    assert _drive(zones=zones, sensor_workers=2) == alone


def test_sensor_workers_of_a_divided_world_give_the_same_results(
    alone: list[list[bytes | str]],
) -> None:
    assert _drive(zones=4, workers=2, sensor_workers=2) == alone


def test_sensor_workers_of_whole_worlds_give_the_same_results() -> None:
    both = _drive(num_envs=2)
    assert _drive(num_envs=2, workers=2, sensor_workers=1) == both
    assert _drive(num_envs=2, sensor_workers=2) == both


@pytest.mark.slow
def test_each_frame_of_ten_thousand_steps_belongs_to_its_tick() -> None:
    settings = {"horizon_s": 2000.0, "clock.ctrl_dt_s": 0.05}
    vec = _make(SMALL, sensor_workers=1, overrides=settings)
    try:
        vec.reset(seed=3)
        idle = np.zeros(vec.action_space.shape, dtype=vec.action_space.dtype)
        for step in range(1, 10_001):
            vec.step(idle)
            stamps = vec.worlds.arrays.frames["wheels"].stamp_s[0, :, -1]
            assert stamps.max() == step * 0.05
    finally:
        vec.close()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_replaced_sensor_worker_gives_the_same_samples(
    alone: list[list[bytes | str]], how: signal.Signals
) -> None:
    vec = _make(sensor_workers=2)
    try:
        vec.reset(seed=7)
        seen = [_results(vec)]
        for step in range(STEPS):
            if step % 4 == 1:
                os.kill(_pids(vec)[1 + step % 2], how)
            vec.step(vec.suggest_actions())
            seen.append(_results(vec))
        assert seen == alone
        assert [how.name in death.cause for death in _sensor_workers(vec).deaths] == [True] * 3
    finally:
        vec.close()


def test_a_worker_that_dies_while_it_senses_changes_no_result(
    alone: list[list[bytes | str]],
) -> None:
    vec = _make(sensor_workers=2)
    stop, may_kill = threading.Event(), threading.Event()

    def kill() -> None:
        while not stop.wait(0.03):
            if (
                may_kill.is_set()
            ):  # at most one kill per step, because four deaths in one step are an error
                may_kill.clear()
                with suppress(ProcessLookupError):
                    os.kill(_pids(vec)[1], signal.SIGKILL)

    try:
        vec.reset(seed=7)
        seen = [_results(vec)]
        killer = threading.Thread(target=kill)
        killer.start()
        for _ in range(STEPS):
            may_kill.set()
            vec.step(vec.suggest_actions())
            seen.append(_results(vec))
            time.sleep(0.02)
        stop.set()
        killer.join()
        assert seen == alone
        assert _sensor_workers(vec).deaths
    finally:
        stop.set()
        vec.close()


def test_the_world_waits_for_a_late_sensor_worker() -> None:
    vec = _make(SMALL, sensor_workers=2)
    try:
        vec.reset(seed=7)
        vec.step(vec.suggest_actions())
        before = _sensor_workers(vec).times.wait_s
        pid = _pids(vec)[1]
        os.kill(pid, signal.SIGSTOP)
        threading.Timer(0.08, os.kill, (pid, signal.SIGCONT)).start()
        vec.step(vec.suggest_actions())
        assert _sensor_workers(vec).times.wait_s - before > 0.05
        assert not _sensor_workers(vec).deaths
    finally:
        vec.close()


def test_a_frame_of_another_tick_is_refused() -> None:
    vec = _make(SMALL, sensor_workers=1)
    try:
        vec.reset(seed=7)
        sensor_workers = _sensor_workers(vec)
        mounted = vec.simulation.mounted
        assert mounted is not None
        sensor = mounted.rig.sensors[0]
        due = sensor_workers.shared.due_of(0, sensor.carriers)
        turn = Turn(0, sensor, due, vec.worlds.arrays.frames[sensor.name])
        turn.due.num[:] = 1
        sensor_workers.shared.delivered[0, 0, 0] += 1
        with pytest.raises(
            WorkerError, match=r"rig\.wheels: the frame of tick 0 is missing.*is of tick 1"
        ):
            sensor_workers.check([turn])
    finally:
        vec.close()


def test_no_process_remains_after_worlds_are_closed_or_deleted() -> None:
    for forgets in (False, True):
        vec = _make(SMALL, sensor_workers=2)
        vec.reset(seed=0)
        pids = _pids(vec)
        descriptors = len(os.listdir("/proc/self/fd"))
        if forgets:
            del vec
            gc.collect()
        else:
            vec.close()
            with pytest.raises(EpisodeError, match="after close"):
                vec.reset(seed=0)
        assert _gone(pids)
        assert len(os.listdir("/proc/self/fd")) < descriptors


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_no_sensor_worker_outlives_the_process_of_its_worlds(how: signal.Signals) -> None:
    text = (
        "import signal, cavmarl\n"
        # A background program ignores Ctrl-C unless it sets this handler.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"settings = {{'rig': {SMALL}}}\n"
        "vec = cavmarl.make_vec('grid4x4', agents=2, sensor_workers=2, overrides=settings)\n"
        "vec.reset(seed=0)\n"
        "pool = vec.worlds.sensor_workers.pool\n"
        "print(pool.server_pid, *pool.pids, flush=True)\n"
        "while True:\n"
        "    vec.step(vec.suggest_actions())\n"
    )
    program = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", text],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert program.stdout is not None
    with program:
        pids = [int(word) for word in program.stdout.readline().split()]
        program.send_signal(how)
        program.wait()
    assert len(pids) == 3
    assert _gone(pids)


def test_a_run_continues_after_an_interrupted_step() -> None:
    vec = _make(SMALL, sensor_workers=1)
    try:
        vec.reset(seed=0)
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        os.kill(_pids(vec)[1], signal.SIGSTOP)
        timer = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            vec.step(vec.suggest_actions())
        signal.signal(signal.SIGINT, before)
        vec.reset(seed=7)
        first = _results(vec)
        vec.reset(seed=7)
        assert _results(vec) == first
    finally:
        vec.close()


def test_parallel_env_can_have_sensor_workers() -> None:
    def drive(count: int) -> list[str]:
        overrides = {"rig": SMALL}
        env = cavmarl.parallel_env("merge", agents=2, sensor_workers=count, overrides=overrides)
        try:
            env.reset(seed=1)
            return [env.state_hash()]
        finally:
            env.close()

    assert drive(1) == drive(0)


@pytest.mark.parametrize(
    ("keywords", "said"),
    [
        ({"overrides": {"rig": {}}, "sensor_workers": 1}, "needs sensors under rig"),
        ({"sensor_workers": -1}, r"workers\.sensors"),
        ({"sensor_workers": 1000}, r"workers\.sensors"),
        ({"sensor_workers": 1, "overrides": {"workers.sensor_placement": "best"}}, "placement"),
        (
            {
                "sensor_workers": 1, "num_envs": 4, "workers": 2,
                "overrides": {"workers.balance_steps": 10},
            },
            r"workers\.balance_steps = 10 with workers\.sensors = 1",
        ),
    ],
)  # fmt: skip
def test_bad_settings_are_refused(keywords: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        _make(SMALL, **keywords)


def test_more_workers_than_cores_cause_a_warning() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _make(SMALL, sensor_workers=200).close()
    assert any("200 sensor workers: there are" in str(one.message) for one in caught)
