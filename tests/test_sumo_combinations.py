"""Worlds with SUMO's traffic together with messages, mounted sensors, workers and followers."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest

import cavmarl
from cavmarl import CavVectorEnv, make_vec
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.verify.equivalence import verify_zones
from tests.cosim.conftest import drive as follow
from tests.support.sumo_worlds import MODES, tiny_file
from tests.test_everything_on import EVERYTHING

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
pytestmark = pytest.mark.filterwarnings("ignore:.*workers.*there are:RuntimeWarning")

PEOPLE = {"agents": 4, "background": 60}
STEPS = 20
# Followers use flat observations and no rig.
PLAIN: dict[str, Any] = {"observation.mode": "ground_truth", "rig": {}, "clock.ctrl_dt_s": 0.1}


def settings(folder: Path, source: str) -> dict[str, Any]:
    """Return settings with SUMO, all sensors and messages."""
    demand = {"traffic.source": source, "traffic.demand": [str(tiny_file(folder))]}
    return EVERYTHING | demand | {"sensors.signal.timing": False, "population.mode": "respawn"}


def drive(
    source: str, folder: Path, steps: int = STEPS, **keywords: Any
) -> list[list[str | bytes]]:
    """Return the frames of all sensors and the hashes of all worlds for each step."""
    overrides = settings(folder, source)
    vec = make_vec("grid4x4", overrides=overrides, **PEOPLE, **keywords)
    try:
        vec.reset(seed=9)
        seen = []
        for _ in range(steps):
            vec.step(vec.suggest_actions())
            seen.append(results(vec))
        told = vec.traffic_stats()
        assert told["departed"] > sum(PEOPLE.values()), "no vehicle of SUMO departed"
        assert told["v2x_received"] > 0
    finally:
        vec.close()
    return seen


def results(vec: CavVectorEnv) -> list[str | bytes]:
    frames = [array.tobytes() for sensor in vec.frames().values() for array in sensor]
    return [*frames, *(vec.state_hash(w) for w in range(vec.num_envs))]


@pytest.mark.parametrize("source", MODES)
def test_a_divided_world_with_all_sensors_and_messages_equals_the_undivided_one(
    tmp_path: Path, source: str
) -> None:
    found = verify_zones(
        "grid4x4",
        (1, 2, 4),
        steps=STEPS,
        seed=9,
        overrides=settings(tmp_path, source),
        check=True,
        **PEOPLE,
    )
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == STEPS
    assert max(result.crossings for result in found.results) > 0


@pytest.mark.parametrize("source", MODES)
def test_results_do_not_depend_on_sensor_workers_and_workers(tmp_path: Path, source: str) -> None:
    alone = drive(source, tmp_path)
    assert drive(source, tmp_path, sensor_workers=2) == alone
    assert drive(source, tmp_path, zones=4, sensor_workers=2) == alone
    assert drive(source, tmp_path, zones=2, workers=2, sensor_workers=1) == alone


@pytest.mark.parametrize("source", MODES)
def test_a_killed_worker_changes_no_result(tmp_path: Path, source: str) -> None:
    """A new worker repeats the commands to SUMO and loads the saved sensors and messages."""
    made: dict[str, Any] = {"num_envs": 2, "overrides": settings(tmp_path, source), **PEOPLE}
    plain, vec = make_vec("grid4x4", **made), make_vec("grid4x4", workers=2, **made)
    try:
        for one in (plain, vec):
            one.reset(seed=9)
        for step in range(STEPS):
            if step in (7, 15):
                os.kill(vec.worlds.pool.pids[step % 2], signal.SIGKILL)
            for one in (plain, vec):
                one.step(one.suggest_actions())
            assert results(plain) == results(vec), step
        assert len(vec.worlds.pool.deaths) == 2
    finally:
        vec.close()
        plain.close()


def followed(source: str, folder: Path, zones: int, address: Path) -> list[str]:
    """Let a follower drive an agent; return the hash of the world after each step."""
    env = cavmarl.parallel_env(
        "grid4x4", zones=zones, overrides=settings(folder, source) | PLAIN, **PEOPLE
    )
    with FollowedWorld(env, address) as world:
        caller = threading.Thread(target=follow, args=(address, ["car_1"]))
        caller.start()
        world.wait_for(1, 10.0)
        world.reset(seed=9)
        found = []
        for _ in range(STEPS):
            world.step()
            found.append(env.state_hash())
        assert world.seats[0].answers == STEPS + 1
    caller.join(10.0)
    assert not caller.is_alive()
    env.close()
    return found


@pytest.mark.parametrize("source", MODES)
def test_results_with_a_follower_do_not_depend_on_zones(tmp_path: Path, source: str) -> None:
    """Equal hashes show that the follower's observations and controls are equal."""
    alone = followed(source, tmp_path, 1, tmp_path / "s")
    assert followed(source, tmp_path, 4, tmp_path / "s") == alone
    assert len(set(alone)) == STEPS
