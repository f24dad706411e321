"""Followed worlds give the same results in worker processes and with sensor workers."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

import cavmarl
from cavmarl.core.errors import ConfigError, FollowerLostError
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower, FollowerView
from cavmarl.engine.step_trace import StepTrace
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from tests.cosim.conftest import drive, make_env, spawn
from tests.cosim.test_followed_world import reference
from tests.cosim.test_killed_followers import DRIVER

STEPS = 8
RIG: dict[str, dict[str, Any]] = {
    "lidar": {"type": "lidar", "rate_hz": 10, "rays": 16, "z_m": 1.6, "noise": [0.02]},
    "wheels": {"type": "odometry", "rate_hz": 20, "noise": [0.1]},
}
Seen = tuple[list[str], list[FollowerView]]


def pool_of(env: cavmarl.CavEnv) -> Any:
    worlds = env.worlds.worlds  # type: ignore[attr-defined] # the time master wraps the worlds
    assert isinstance(worlds, PooledWorlds)
    return worlds.pool


@pytest.mark.parametrize(("zones", "workers"), [(1, 1), (2, 1), (2, 2)])
def test_killed_workers_are_replaced(
    address: Path, start: Callable[..., threading.Thread], zones: int, workers: int
) -> None:
    env = make_env(zones=zones, workers=workers)
    with closing(env), FollowedWorld(env, address) as world:
        start(lambda: drive(address, ["car_1"]))
        world.wait_for(1, 30.0)
        world.reset(seed=1)
        found = []
        for step in range(STEPS):
            if step % 3 == 1:
                os.kill(pool_of(env).pids[step % workers], signal.SIGKILL)
            world.step()
            found.append(env.state_hash())
        assert len(pool_of(env).deaths) == 3
    assert found == reference(STEPS, {"car_1": None})


def test_killed_followers_are_dropped(address: Path) -> None:
    env = make_env(zones=2, workers=2)
    with (
        closing(env),
        FollowedWorld(env, address) as world,
        spawn(DRIVER, address, "car_0") as process,
    ):
        try:
            world.wait_for(1, 60.0)
            world.reset(seed=1)
            world.step()
            process.kill()
            process.wait()
            os.kill(pool_of(env).pids[0], signal.SIGKILL)
            with pytest.raises(FollowerLostError):
                world.step()
            assert world.seats == ()
            assert env.state_hash() == reference(2, {"car_0": None})[-1]
            world.step()
            assert world.master.world_ticks.tolist() == [3]
        finally:
            process.kill()


def _steer(sight: FollowerView) -> dict[str, list[float]]:
    found = {}
    for vehicle in sight.snapshot.vehicles:
        speed = sight.sensors[vehicle]["wheels"].values[-1, 0] if sight.sensors[vehicle] else 0.0
        found[vehicle] = [0.3 if speed < 6.0 else -0.2, 0.0]
    return found


def _followed(address: Path, start: Callable[..., threading.Thread], **more: Any) -> Seen:
    """Return the hashes of a world, and the views of a follower that drives two of its vehicles."""
    overrides = {"rig": RIG, "population.mode": "respawn", "clock.ctrl_dt_s": 0.05}
    env = cavmarl.parallel_env(
        "grid4x4",
        agents=4,
        background=40,
        zones=more.pop("zones", 1),
        workers=more.pop("workers", 0),
        sensor_workers=more.pop("sensor_workers", 0),
        overrides=overrides | more,
    )
    sights: list[FollowerView] = []
    hashes = []

    def follow() -> None:
        with Follower(address, ["car_0", "car_2"]) as follower:
            for sight in follower:
                sights.append(sight)
                if not sight.snapshot.is_over:
                    follower.answer(_steer(sight))

    with closing(env), FollowedWorld(env, address, timeout_s=60.0) as world:
        thread = start(follow)
        world.wait_for(1, 30.0)
        world.reset(seed=4)
        for _ in range(STEPS):
            world.step()
            hashes.append(env.state_hash())
    thread.join(30.0)
    return hashes, sights


@pytest.fixture(scope="module")
def undivided(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """Return the results of the undivided world in one process."""
    threads = []

    def start(action: Callable[[], None]) -> threading.Thread:
        threads.append(threading.Thread(target=action))
        threads[0].start()
        return threads[0]

    return _followed(tmp_path_factory.mktemp("whole") / "s", start)


@pytest.mark.parametrize(
    "how",
    [
        {"sensor_workers": 1},
        {"workers": 1},
        {"workers": 2},
        {"workers": 1, "sensor_workers": 1},
    ],
    ids=str,
)
def test_followers_see_the_same_in_worker_processes(
    address: Path,
    start: Callable[..., threading.Thread],
    undivided: Seen,
    how: dict[str, Any],
) -> None:
    hashes, sights = _followed(address, start, zones=2, **how)
    assert hashes == undivided[0]
    assert len(sights) == STEPS + 1
    for found, expected in zip(sights, undivided[1], strict=True):
        assert found.snapshot == expected.snapshot
        assert list(found.snapshot.vehicles) == ["car_0", "car_2"]
        for vehicle, sensors in expected.sensors.items():
            assert found.sensors[vehicle].keys() == sensors.keys()
            for name, samples in sensors.items():
                there = found.sensors[vehicle][name]
                for ours, theirs in zip(vars(there).values(), vars(samples).values(), strict=True):
                    assert ours.tobytes() == theirs.tobytes()


def test_a_trace_of_steps_is_refused_if_workers_run_the_world(address: Path) -> None:
    with (
        closing(make_env(workers=1)) as env,
        pytest.raises(ConfigError, match="use backend='local'"),
    ):
        FollowedWorld(env, address, trace=StepTrace())
    assert not address.exists()
