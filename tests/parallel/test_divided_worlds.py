"""Worlds whose zones are run by hosts are the undivided ones, whichever host dies."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import psutil
import pytest

from cavmarl import ConfigError, make_vec, parallel_env
from cavmarl.core.errors import WorkerDeathError, WorkerError, WorkerFailureError
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.split_hosts.divided_worlds import DividedWorlds
from tests.parallel.test_moving import RESTLESS, uneven
from tests.parallel.test_parallel_worlds import drive as drive_view
from tests.parallel.test_parallel_worlds import settings
from tests.support.actuated import actuated_grid
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand
from tests.support.sumo_worlds import MODES, write_stops
from tests.support.vec_runs import Make, drive, same
from tests.support.world_hosts import WorldHosts

__all__ = ["uneven"]

ROOT = Path(__file__).resolve().parents[2]
WANTED: dict[str, Any] = {"agents": 8, "background": 30, "max_cycles": 8}
DEADLY = str(ROOT / "examples/faults.json")
SEATS = {"population.mode": "respawn", "action.kind": "discrete"}


@pytest.fixture(autouse=True)
def without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavmarl.parallel.split_hosts.divided_worlds.RayActors", WorldHosts)


def divided(vec: CavVectorEnv) -> DividedWorlds:
    assert isinstance(vec.worlds, DividedWorlds)
    return vec.worlds


class Killer:
    """Sends signals to hosts at random times; one death at a time, since a new host takes long."""

    def __init__(self, vec: CavVectorEnv, *steps: int) -> None:
        self._pool = divided(vec).pool
        self._steps = steps
        self._random = random.Random(3)
        self.timers: list[Timer] = []

    def __call__(self, step: int) -> None:
        if step in self._steps:
            self._pool.await_spare()
            how = (signal.SIGKILL, signal.SIGSTOP)[len(self.timers) % 2]
            victim = self._random.randrange(len(self._pool.pids))
            delay_s = self._random.uniform(0.0, 0.01)
            self.timers.append(Timer(delay_s, os.kill, (self._pool.pids[victim], how)))
            self.timers[-1].start()

    def count(self) -> int:
        """How many have died, when all are missed that were struck."""
        for timer in self.timers:
            timer.join()
        self._pool.ping()
        assert len(self._pool.deaths) == len(self.timers)
        return len(self.timers)


@pytest.mark.parametrize(
    ("arguments", "workers"),
    [
        ({"env": "grid4x4"}, 2),
        ({"env": "grid4x4", "num_envs": 2}, 3),
        ({"env": "merge", "autoreset_mode": "NextStep"}, 2),
        ({"env": "rush"}, 2),
        ({"env": "town", "overrides": {**SEATS, "sensors.stack": 3}}, 4),
        ({"env": "town", "overrides": {"clock.control_latency_ticks": 2}}, 2),
    ],
)
def test_nobody_can_tell(make: Make, arguments: dict[str, Any], workers: int) -> None:
    wanted = WANTED | arguments
    whole = drive(make(**wanted))
    vec = make(zones=4, workers=workers, hosts="ray", **wanted)
    assert same(drive(vec), whole)
    assert same(drive(vec), whole)
    assert divided(vec).deaths == []
    assert len(divided(vec).pool.pids) == workers
    (plan,) = vec.plans
    assert sorted({*plan.homes}) == list(range(workers))


@pytest.mark.parametrize("env", ["grid4x4", "town"])
def test_hosts_that_die_at_any_time(make: Make, env: str) -> None:
    """In ticks that put the rows in order, too."""
    wanted = {"agents": 6, "background": 60, "max_cycles": 20}
    whole = drive(make(env, **wanted), steps=40)
    vec = make(env, zones=4, workers=2, hosts="ray", **wanted)
    strike = Killer(vec, 4, 10, 17, 18, 30, 36)
    assert same(drive(vec, steps=40, before=strike), whole)
    assert strike.count() == 6


def test_all_hosts_die_at_once(make: Make) -> None:
    whole = drive(make("grid4x4", **WANTED))
    vec = make("grid4x4", zones=4, workers=2, hosts="ray", **WANTED)

    def strike(step: int) -> None:
        if step == 5:
            for pid in divided(vec).pool.pids:
                os.kill(pid, signal.SIGKILL)

    assert same(drive(vec, before=strike), whole)
    assert len(divided(vec).deaths) == 2


@pytest.mark.parametrize("mode", ["ground_truth", "sensors"])
def test_rigs_are_sensed_for_by_the_hosts(make: Make, mode: str) -> None:
    overrides = {"rig": "ten_sensors", "observation.mode": mode}
    wanted = {"agents": 5, "background": 60, "max_cycles": 8, "overrides": overrides}
    one = make("town", **wanted)
    whole = drive(one)
    vec = make("town", zones=4, workers=2, hosts="ray", **wanted)
    strike = Killer(vec, 3, 7)
    assert same(drive(vec, before=strike), whole)
    assert strike.count() == 2
    for name, frames in one.worlds.arrays.frames.items():
        for ours, theirs in zip(vec.worlds.arrays.frames[name], frames, strict=True):
            assert np.array_equal(ours, theirs), name
        assert frames.data.any(), name


def test_actuated_signals(make: Make, tmp_path: Path) -> None:
    wanted = {"agents": 4, "background": 30, "max_cycles": 25}
    net = actuated_grid(tmp_path)
    whole = drive(make(net, **wanted), steps=40)
    vec = make(net, zones=4, workers=2, hosts="ray", **wanted)
    assert same(drive(vec, steps=40, before=Killer(vec, 20)), whole)


def test_vehicles_that_look_for_another_way(make: Make, tmp_path: Path) -> None:
    net = make_map(tmp_path)
    files = write_demand(tmp_path, CARS.format(device=DEVICE) + FLOW)
    overrides = {
        "population.mode": "respawn",
        "traffic.demand": [str(path) for path in files],
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 1.0,
    }
    wanted = {"agents": 2, "background": 0, "max_cycles": 500, "overrides": overrides}
    one = make(net, **wanted)
    whole = drive(one, steps=300)
    vec = make(net, zones=3, workers=2, hosts="ray", **wanted)
    strike = Killer(vec, 140, 221)
    assert same(drive(vec, steps=300, before=strike), whole)
    assert strike.count() == 2
    assert one.traffic_stats()["rerouted"] > 0, "nobody has taken another way"


def test_what_this_process_does_beside_the_zones(make: Make, tmp_path: Path) -> None:
    """Messages between vehicles, the protocol's journal, its checks."""
    wanted = {**WANTED, "overrides": {"v2x.enabled": True}}
    whole = drive(make("grid4x4", **wanted))
    journal = tmp_path / "journal.jsonl"
    wanted["overrides"] |= {"zones.journal": str(journal), "zones.check_invariants": True}
    vec = make("grid4x4", zones=4, workers=2, hosts="ray", **wanted)
    assert same(drive(vec, before=Killer(vec, 6)), whole)
    assert journal.stat().st_size > 0
    assert vec.simulation.migrations > 0
    assert len(vec.simulation.zone_view().owners) > 0


def test_messages_of_the_protocol_may_be_lost(make: Make, tmp_path: Path) -> None:
    whole = drive(make("grid4x4", **WANTED), steps=20)
    plan = tmp_path / "faults.json"
    plan.write_text('{"seed": 1, "messages": {"Prepare": {"drop": 0.3}, "Step": {"drop": 0.2}}}')
    lossy = {"zones.faults": str(plan)}
    vec = make("grid4x4", zones=4, workers=2, hosts="ray", overrides=lossy, **WANTED)
    assert same(drive(vec, steps=20), whole)


def test_zones_that_change_their_host(make: Make, uneven: list[int]) -> None:
    whole = drive(make("town", **WANTED), steps=20)
    vec = make("town", zones=4, workers=2, hosts="ray", overrides=RESTLESS, **WANTED)
    strike = Killer(vec, 9)
    assert same(drive(vec, steps=20, before=strike), whole)
    assert strike.count() == 1
    mover = divided(vec).mover
    assert mover is not None
    assert mover.moves == sum(uneven) > 0


def test_hosts_measure_what_zones_cost(make: Make) -> None:
    vec = make(
        "town", zones=4, workers=2, hosts="ray", overrides={"workers.balance_steps": 1000}, **WANTED
    )
    drive(vec, steps=60)
    assert (divided(vec).spent_s > 0.0).all()


def test_the_view_of_pettingzoo_is_the_one_of_one_process() -> None:
    whole = drive_view(parallel_env("grid4x4", **settings("open", "dict")))
    more: dict[str, Any] = {"workers": 2, "hosts": "ray", "render_mode": "rgb_array"}
    env = parallel_env("grid4x4", **settings("open", "dict"), **more)
    assert isinstance(env.worlds, DividedWorlds)
    assert drive_view(env) == whole
    env.reset(seed=0)
    picture = env.render()
    assert picture is not None
    assert picture.std() > 0.0
    env.close()
    with pytest.raises(WorkerError, match="closed"):
        env.reset(seed=0)


@pytest.mark.parametrize("source", MODES)
def test_sumo_beside_the_world(make: Make, tmp_path: Path, source: str) -> None:
    overrides = {
        "traffic.source": source,
        "traffic.demand": [str(path) for path in write_stops(tmp_path)],
        "sensors.signal.timing": False,
    }
    wanted = {"agents": 3, "background": 0, "max_cycles": 20, "overrides": overrides}
    whole = drive(make("merge", **wanted), steps=30)
    vec = make("merge", zones=2, workers=2, hosts="ray", **wanted)
    assert same(drive(vec, steps=30, before=Killer(vec, 10)), whole)


@pytest.mark.parametrize("is_late", [False, True])
def test_an_interruption_is_told(
    make: Make, monkeypatch: pytest.MonkeyPatch, is_late: bool
) -> None:
    """Late: hosts have run the phase, and nobody has taken what has come of it."""
    vec = make("grid4x4", zones=4, workers=2, hosts="ray", **WANTED)
    whole = drive(vec)
    tell, calls = divided(vec).pool.tell, []

    def interrupted(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) != 4:
            return tell(*arguments)
        if is_late:
            tell(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(divided(vec).pool, "tell", interrupted)
    vec.reset(seed=1)
    with pytest.raises(KeyboardInterrupt):
        vec.step(vec.suggest_actions())
    with pytest.raises(WorkerError, match="interrupted in the middle of a step: reset all"):
        vec.step(np.zeros((1, vec.num_agents, 2), dtype=np.float32))
    assert same(drive(vec), whole)
    assert divided(vec).deaths == []


def test_an_order_that_everybody_dies_of(make: Make) -> None:
    vec = make(
        "grid4x4", zones=4, workers=2, hosts="ray", overrides={"workers.max_retries": 0}, **WANTED
    )
    vec.reset(seed=0)
    os.kill(divided(vec).pool.pids[1], signal.SIGKILL)
    with pytest.raises(WorkerDeathError, match=r"zones? 2") as caught:
        vec.step(np.zeros((1, vec.num_agents, 2), dtype=np.float32))
    assert caught.value.worker == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"zones": 2, "workers": 3}, r"workers = 3.*at most as many as zones; use fewer workers"),
        ({"zones": 2, "workers": 4, "num_envs": 2}, r"same zones of all worlds"),
        ({"workers": 2}, r"1 world.s. of 1 zone"),
        (
            {"overrides": {"zones.repartition_steps": 5}},
            r"zones.repartition_steps.*zones that stay",
        ),
        (
            {"overrides": {"workers.monitor_cpu": True}},
            r"workers.monitor_cpu = True, hosts = 'ray'",
        ),
        ({"sensor_workers": 1, "overrides": {"rig": "ten_sensors"}}, r"workers.sensors = 1, hosts"),
        ({"overrides": {"zones.faults": DEADLY}}, r"die by plan.*workers=0"),
    ],
)
def test_settings_that_cannot_be(arguments: dict[str, Any], words: str) -> None:
    given = {"zones": 4, "workers": 2} | arguments
    if arguments == {"workers": 2}:
        del given["zones"]
    with pytest.raises(ConfigError, match=words):
        make_vec("grid4x4", hosts="ray", **given)


KILLED = """
import os, signal
import cavmarl.parallel.split_hosts.divided_worlds as divided
from tests.support.world_hosts import WorldHosts

if __name__ == "__main__":
    from cavmarl import make_vec
    divided.RayActors = WorldHosts
    vec = make_vec("grid4x4", zones=4, workers=2, hosts="ray")
    vec.reset(seed=0)
    print(*(process.pid for process in vec.worlds.pool._launcher.processes), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_nothing_is_left_behind(make: Make) -> None:
    vec = make("grid4x4", zones=4, workers=2, hosts="ray")
    vec.reset(seed=0)
    pids = divided(vec).pool.pids
    vec.close()
    assert not any(psutil.pid_exists(pid) for pid in pids)
    done = subprocess.run(
        [sys.executable, "-c", KILLED], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    pids = [int(word) for word in done.stdout.split()]
    assert len(pids) == 3, done.stderr
    until_s = time.monotonic() + 10.0
    while any(psutil.pid_exists(pid) for pid in pids):
        assert time.monotonic() < until_s
        time.sleep(0.1)


def test_a_host_that_fails(make: Make) -> None:
    """Its words are the caller's error; after a reset all goes on."""
    vec = make("grid4x4", zones=4, workers=2, hosts="ray", **WANTED)
    whole = drive(vec)
    leader = divided(vec).leader
    before = leader.zones
    leader.host([[0, 1], [2, 99]])
    with pytest.raises(WorkerFailureError, match="IndexError"):
        vec.reset(seed=0)
    leader.host(before)
    assert same(drive(vec), whole)
    assert divided(vec).deaths == []
