"""Vehicles that the caller inserts into running worlds are equal in all divisions and recorded."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import ActionError, CapacityError, CavEnv, ConfigError, make_vec, parallel_env
from cavmarl.recordings.recording import Recording
from tests.support.acted_on import hashes_of

ROOM = {"population.insertions": 12}


def edge_of(env: CavEnv, k: int = 0) -> str:
    """Return the id of the k-th road that has vehicles."""
    rows = env.simulation.vehicles(0)
    lanes = env.network.lanes[rows["lane"]]
    edges = np.unique(lanes["edge"][~lanes["internal"]])
    return env.network.edge_ids[int(edges[k])]


def act(env: Any, step: int) -> None:
    """Insert a vehicle if an insertion is planned for this step."""
    network = env.network
    roads = np.flatnonzero(~network.lanes["internal"] & (network.lanes["length_m"] > 60.0))
    if step in (4, 5, 30):
        env.insert_vehicle(network.lane_ids[int(roads[step])], 20.0 + step)


hashes = partial(hashes_of, act=act, overrides=ROOM, agents=3, background=40, steps=60, every=10)


def test_a_divided_world_with_insertions_equals_the_undivided_one() -> None:
    undivided = hashes()
    assert hashes(zones=4) == undivided
    assert hashes(zones=4, workers=2) == undivided


@pytest.mark.slow
def test_worlds_over_nodes_equal_the_undivided_one() -> None:
    assert hashes(zones=2, nodes=2) == hashes()


def test_unused_slots_for_insertions_change_no_result() -> None:
    found = []
    for overrides in ({}, ROOM):
        with closing(parallel_env("grid4x4", agents=3, overrides=overrides)) as env:
            env.reset(seed=2)
            for _ in range(30):
                env.step(env.suggest_actions())
            found.append(env.state_hash())
    assert found[0] == found[1]


def test_a_run_can_be_repeated_from_the_recorded_insertions(tmp_path: Path) -> None:
    with closing(
        parallel_env("grid4x4", agents=3, background=40, overrides=ROOM, record=tmp_path / "run")
    ) as env:
        env.reset(seed=2)
        for step in range(40):
            act(env, step)
            env.step(env.suggest_actions())
        wanted = env.state_hash()
    recording = Recording.open(tmp_path / "run")
    told = {}
    for found in recording.events():
        if found.event.kind == "inserted":
            told.setdefault(found.event.tick, []).append(found.event)
    assert sum(map(len, told.values())) == 3
    ticks = recording.ticks()
    with closing(parallel_env("grid4x4", agents=3, background=40, overrides=ROOM)) as env:
        env.reset(seed=2)
        for tick in ticks[1:]:
            for event in told.get(tick, ()):
                lane, place = event.detail.rsplit(" ", 1)
                env.insert_vehicle(lane, float(place))
            env.step(env.suggest_actions())
        assert env.state_hash() == wanted


def test_an_inserted_vehicle_drives() -> None:
    with closing(parallel_env("grid4x4", agents=1, background=0, overrides=ROOM)) as env:
        env.reset(seed=0)
        lanes = env.network.lanes
        mine = int(env.simulation.vehicles(0)["lane"][0])
        others = np.flatnonzero(
            ~lanes["internal"] & (lanes["edge"] != lanes["edge"][mine]) & (lanes["length_m"] > 60)
        )
        lane = env.network.lane_ids[int(others[0])]
        env.insert_vehicle(lane, 30.0)
        env.step(env.suggest_actions())
        rows = env.simulation.vehicles(0)
        new = rows[rows["agent"] < 0][0]
        assert env.network.lane_ids[int(new["lane"])] == lane
        for _ in range(100):
            env.step(env.suggest_actions())
        rows = env.simulation.vehicles(0)
        assert rows[rows["id"] == new["id"]]["distance_m"][0] > 20.0


def test_a_repeated_step_has_the_insertions_of_the_failed_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    overrides = {**ROOM, "v2x.enabled": True, "map.changed_lanes": 4}
    found = []
    for fails in (False, True):
        with closing(parallel_env("grid4x4", agents=3, overrides=overrides)) as env:
            env.reset(seed=2)
            act(env, 4)
            env.close_road(edge_of(env, 2))
            env.declare_event("car_0", "obstacle")
            if fails:
                actions = env.suggest_actions()
                with monkeypatch.context() as patch:
                    patch.setattr(env.worlds, "step", interrupted)
                    with pytest.raises(KeyboardInterrupt):
                        env.step(actions)
                assert env.closed_roads() == (edge_of(env, 2),)
            for _ in range(10):
                env.step(env.suggest_actions())
            found.append((env.state_hash(), env.traffic_stats()))
    assert found[0] == found[1]


def test_an_event_that_was_declared_before_a_reset_is_dropped() -> None:
    found = {}
    for declared in ("never", "before", "after"):
        with closing(parallel_env("merge", agents=2, overrides={"v2x.enabled": True})) as env:
            env.reset(seed=2)
            if declared == "before":
                env.declare_event("car_0", "obstacle")
            env.reset(seed=2)
            if declared == "after":
                env.declare_event("car_0", "obstacle")
            env.step(env.suggest_actions())
            found[declared] = env.state_hash()
    assert found["before"] == found["never"]
    assert found["after"] != found["never"]


def interrupted(commands: Any) -> None:
    raise KeyboardInterrupt


def test_invalid_insertions_are_refused_with_a_remedy() -> None:
    with closing(parallel_env("grid4x4")) as env:
        env.reset(seed=0)
        with pytest.raises(ConfigError, match=r"set population\.insertions"):
            env.insert_vehicle(env.network.lane_ids[0], 1.0)
    with closing(make_vec("grid4x4", num_envs=2, overrides={"population.insertions": 2})) as vec:
        vec.reset(seed=0)
        roads = np.flatnonzero(~vec.network.lanes["internal"])
        lane = vec.network.lane_ids[int(roads[0])]
        inside = vec.network.lane_ids[int(np.flatnonzero(vec.network.lanes["internal"])[0])]
        with pytest.raises(ActionError, match="no such lane; give the id of one"):
            vec.insert_vehicle("nowhere", 1.0)
        with pytest.raises(ActionError, match="give a car lane of a road"):
            vec.insert_vehicle(inside, 1.0)
        with pytest.raises(ActionError, match="m long; give a position on it"):
            vec.insert_vehicle(lane, float("nan"))
        with pytest.raises(ActionError, match="must be from 0 to 1"):
            vec.insert_vehicle(lane, 1.0, world=2)
        for _ in range(2):
            vec.insert_vehicle(lane, 10.0, world=1)
        with pytest.raises(CapacityError, match=r"increase population\.insertions, or reset"):
            vec.insert_vehicle(lane, 10.0, world=1)
        vec.insert_vehicle(lane, 10.0, world=0)
        vec.reset()
        vec.insert_vehicle(lane, 10.0, world=1)
    with pytest.raises(ConfigError, match=r"population\.insertions = 3: .*needs a single map"):
        parallel_env("cities", overrides={"population.insertions": 3})


def test_saved_states_include_waiting_insertions() -> None:
    def finished(step: int, saved: bytes | None) -> tuple[str, bytes | None]:
        with closing(make_vec("grid4x4", background=20, overrides=ROOM)) as vec:
            vec.reset(seed=1)
            if saved is not None:
                vec.load_state(saved)
            kept = None
            for now in range(step, 30):
                if saved is None:
                    act(vec, now)
                if now == 10 and saved is None:
                    kept = vec.save_state()
                if now > 10 and saved is not None:
                    act(vec, now)
                vec.step(vec.suggest_actions())
            return vec.state_hash(0), kept

    wanted, saved = finished(0, None)
    assert finished(10, saved)[0] == wanted
