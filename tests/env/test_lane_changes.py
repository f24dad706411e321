"""Worlds with roads that the caller closes or damages: divisions, saved states, recordings."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import ActionError, CapacityError, ConfigError, make_vec, parallel_env
from cavmarl.recordings.recording import Recording
from cavmarl.sensors.observed import feature_names
from tests.support.acted_on import hashes_of
from tests.support.saved_midway import check_resumed

ROOM = {"map.changed_lanes": 40}


def damage(env: Any, step: int) -> None:
    """Damage or repair roads if this is planned for the step."""
    if step == 3:
        for edge in ("B1B2", "B2B1", "B1C1", "C1B1"):
            env.damage_road(edge, 3.0)
    if step == 8:
        env.damage_road("A1B1", 2.5, lanes=[0])
    if step == 20:
        env.damage_road("B1B2", 13.89)


hashes = partial(hashes_of, act=damage, overrides=ROOM, agents=3, background=40, steps=40, every=5)


def test_a_divided_world_with_speed_limits_equals_the_undivided_one() -> None:
    undivided = hashes()
    assert hashes(zones=4) == undivided
    assert hashes(zones=4, workers=2) == undivided
    assert hashes(act=lambda env, step: None, steps=5) != undivided[:1]


@pytest.mark.slow
def test_worlds_with_speed_limits_over_nodes_are_equal() -> None:
    assert hashes(zones=2, nodes=2) == hashes()


def test_saved_states_include_speed_limits() -> None:
    check_resumed(damage, ROOM, at=12, steps=30)


def test_drivers_and_sensors_use_the_speed_limit_of_their_world() -> None:
    room = {"map.changed_lanes": 480}
    with closing(make_vec("grid4x4", num_envs=2, background=30, overrides=room)) as vec:
        vec.reset(seed=1)
        for edge in road_ids(vec):
            vec.damage_road(edge, 3.0, world=1)
        for _ in range(150):
            observations = vec.step(vec.suggest_actions())[0]
        limit = feature_names(vec.config.sensors).index(("ego", "speed_limit"))
        inside = vec.network.lanes["internal"]
        for world, most_mps in ((0, 13.89), (1, 3.0)):
            rows = vec.simulation.vehicles(world)
            rows = rows[~inside[rows["lane"]]]
            assert rows["speed"].max() <= 1.2 * most_mps
            own = rows[rows["agent"] >= 0]
            seen = observations.reshape(2, -1, observations.shape[-1])[world, own["agent"], limit]
            assert np.allclose(seen, most_mps / 40.0)
        assert vec.simulation.vehicles(0)["speed"].max() > 6.0


def test_invalid_speed_limits_are_refused_with_a_remedy() -> None:
    with closing(parallel_env("grid4x4", overrides={"map.changed_lanes": 3})) as env:
        env.reset(seed=1)
        with pytest.raises(ActionError, match="edge 'Z9': the map has no such road; give the id"):
            env.damage_road("Z9", 3.0)
        for speed_mps in (0.0, -1.0, 13.9, float("nan")):
            with pytest.raises(ActionError, match="give a speed above 0 and at most that"):
                env.damage_road("B1B2", speed_mps)
        with pytest.raises(ActionError, match="has the lanes 0 to 1, from the kerb"):
            env.damage_road("B1B2", 3.0, lanes=[2])
        with pytest.raises(ActionError, match="world 1: must be from 0 to 0"):
            env.damage_road("B1B2", 3.0, world=1)
        env.damage_road("B1B2", 3.0)
        with pytest.raises(CapacityError, match=r"map\.changed_lanes = 3; set it higher"):
            env.damage_road("B2B1", 3.0)
    with closing(parallel_env("grid4x4")) as env:
        env.reset(seed=1)
        with pytest.raises(ConfigError, match=r"set map\.changed_lanes"):
            env.damage_road("B1B2", 3.0)


def road_ids(env: Any) -> list[str]:
    """Return the ids of all roads."""
    network = env.network
    return [network.edge_ids[row] for row in np.flatnonzero(~network.edges["internal"]).tolist()]


CLOSED = ("B1B2", "B2B1", "B1C1", "C1B1")


def close(env: Any, step: int) -> None:
    """Close, damage or open roads if this is planned for the step."""
    if step == 3:
        for edge in CLOSED:
            env.close_road(edge)
        env.close_road("A1B1", lanes=[1])
    if step == 14:
        env.damage_road("C2B2", 4.0)
    if step == 25:
        env.open_road("B1B2")
        env.open_road("A1B1", lanes=[1])


@pytest.mark.parametrize("reroute", ["never", "blocked", "always"])
def test_a_divided_world_with_closed_roads_equals_the_undivided_one(reroute: str) -> None:
    overrides = {**ROOM, "population.reroute": reroute}
    undivided = hashes(act=close, overrides=overrides)
    assert hashes(act=close, overrides=overrides, zones=4) == undivided
    if reroute == "blocked":
        assert hashes(act=close, overrides=overrides, zones=4, workers=2) == undivided


@pytest.mark.slow
def test_worlds_with_closed_roads_over_nodes_are_equal() -> None:
    assert hashes(act=close, zones=2, nodes=2) == hashes(act=close)


def test_saved_states_include_closed_roads() -> None:
    check_resumed(close, ROOM, at=12, steps=40)


def test_the_state_of_a_world_does_not_depend_on_the_process_that_runs_it() -> None:
    def found(**more: Any) -> list[str]:
        with closing(make_vec("grid4x4", num_envs=2, background=40, overrides=ROOM, **more)) as vec:
            vec.reset(seed=2)
            for step in range(30):
                if step == 3:
                    for edge in CLOSED:
                        vec.close_road(edge, world=1)
                vec.step(vec.suggest_actions())
            assert vec.traffic_stats(0)["rerouted"] == 0
            assert vec.traffic_stats(1)["rerouted"] > 0
            return [vec.state_hash(0), vec.state_hash(1)]

    assert found() == found(workers=2)


def drive_past(reroute: str, steps: int = 400) -> tuple[dict[str, float], int, int]:
    """Drive with closed roads; return statistics of the traffic.

    Returns:
        The traffic statistics, the number of steps after 10 s in which a vehicle entered a closed
        road, and the number of vehicles on closed roads at the end.
    """
    overrides = {**ROOM, "population.reroute": reroute, "population.mode": "respawn"}
    with closing(parallel_env("grid4x4", agents=4, background=60, overrides=overrides)) as env:
        env.reset(seed=3)
        for edge in CLOSED:
            env.close_road(edge)
        closed = np.isin(
            env.network.lanes["edge"], [env.network.edge_ids.index(edge) for edge in CLOSED]
        )
        before: set[int] = set()
        entered = 0
        for step in range(steps):
            env.step(env.suggest_actions())
            rows = env.simulation.vehicles(0)
            there = set(rows["id"][closed[rows["lane"]]].tolist())
            entered += step >= 100 and bool(there - before)
            before = there
        return env.traffic_stats(), entered, len(before)


def test_vehicles_leave_closed_roads_and_take_other_routes() -> None:
    waits, entered, left = drive_past("never")
    assert (entered, left, waits["rerouted"]) == (0, 0, 0)
    takes, entered, left = drive_past("blocked")
    assert (entered, left) == (0, 0)
    assert takes["rerouted"] > 5
    assert takes["arrived"] > waits["arrived"]
    assert takes["mean_speed_mps"] > waits["mean_speed_mps"]
    assert takes["contacts"] == waits["contacts"] == 0


def test_vehicles_leave_a_closed_lane_to_the_adjacent_lane() -> None:
    with closing(parallel_env("grid4x4", agents=1, background=60, overrides=ROOM)) as env:
        env.reset(seed=3)
        network = env.network
        closed = [network.lane_ids.index(f"{edge}_0") for edge in CLOSED]
        on_closed = np.isin(env.simulation.vehicles(0)["lane"], closed)
        assert on_closed.sum() > 1
        for edge in CLOSED:
            env.close_road(edge, lanes=[0])
        used = False
        for _ in range(200):
            env.step(env.suggest_actions())
            lanes = network.lanes[env.simulation.vehicles(0)["lane"]]
            edges = [network.edge_ids[edge] for edge in lanes["edge"].tolist()]
            used |= bool((np.isin(edges, CLOSED) & (lanes["index"] == 1)).any())
        assert not np.isin(env.simulation.vehicles(0)["lane"], closed).any()
        assert used


def ahead(env: Any, agent: int) -> str:
    """Return the road behind the next junction on an agent's route."""
    network, steps = env.network, env.simulation.travel.steps
    rows = env.simulation.vehicles(0)
    row = rows[rows["agent"] == agent][0]
    lane = int(row["lane"])
    while network.lanes["internal"][lane]:
        lane = int(network.lanes["successor"][lane])
    step = steps[row["way"] + lane]
    while step["change"]:
        lane = int(network.lanes["left" if step["change"] > 0 else "right"][lane])
        step = steps[row["way"] + lane]
    beyond = int(network.links["to_lane"][step["link"]])
    return str(network.edge_ids[network.lanes["edge"][beyond]])


def test_a_detour_gives_an_agent_no_large_negative_reward_and_a_later_time_limit() -> None:
    overrides = {**ROOM, "terms.weights": {"progress": 1.0}, "traffic.trip_horizon": 3.0}
    with closing(parallel_env("grid4x4", agents=6, background=0, overrides=overrides)) as env:
        env.reset(seed=3)
        before = env.simulation.vehicles(0).copy()
        for agent in range(6):
            env.close_road(ahead(env, agent), shuts_in=True)
        least = 0.0
        for _ in range(12):
            rewards = env.step(env.suggest_actions())[1]
            least = min(least, *rewards.values())
        after = env.simulation.vehicles(0)
        _, old, new = np.intersect1d(before["id"], after["id"], return_indices=True)
        on_detour = after["leg"][new] > before["leg"][old]
        assert on_detour.sum() > 1
        assert (after["due"][new] >= before["due"][old]).all()
        assert (after["due"][new] > before["due"][old])[on_detour].any()
        assert least > -2.0


def test_a_run_with_closed_roads_can_be_repeated_from_its_recording(tmp_path: Path) -> None:
    with closing(parallel_env("grid4x4", agents=3, overrides=ROOM, record=tmp_path / "run")) as env:
        env.reset(seed=2)
        for step in range(40):
            close(env, step)
            env.step(env.suggest_actions())
        wanted = env.state_hash()
    recording = Recording.open(tmp_path / "run")
    told: dict[int, list[Any]] = {}
    for found in recording.events():
        if found.event.kind in ("closed", "opened", "damaged"):
            told.setdefault(found.event.tick, []).append(found.event)
    assert sum(map(len, told.values())) == 8
    with closing(parallel_env("grid4x4", agents=3, overrides=ROOM)) as env:
        env.reset(seed=2)
        for tick in recording.ticks()[1:]:
            for event in told.get(tick, ()):
                edge, *rest = event.detail.split(" ")
                if event.kind == "damaged":
                    env.damage_road(edge, float(rest[0]))
                    continue
                lanes = [int(lane) for lane in rest[0].split(",")] if rest else None
                (env.close_road if event.kind == "closed" else env.open_road)(edge, lanes)
            env.step(env.suggest_actions())
        assert env.state_hash() == wanted


def test_invalid_closures_are_refused_with_a_remedy() -> None:
    with closing(parallel_env("grid4x4", overrides={"map.changed_lanes": 9})) as env:
        env.reset(seed=1)
        with pytest.raises(ActionError, match="edge 'Z9': the map has no such road; give the id"):
            env.close_road("Z9")
        with pytest.raises(ActionError, match=r"lanes = \[-1\]: edge 'B1B2' has the lanes 0 to 1"):
            env.close_road("B1B2", lanes=[-1])
        with pytest.raises(ActionError, match="'B1B2' is neither closed nor damaged"):
            env.open_road("B1B2")
        for edge in ("A0left0", "A0bottom0"):
            env.close_road(edge)
        assert env.closed_roads() == ("A0left0", "A0bottom0") or env.closed_roads() == (
            "A0bottom0",
            "A0left0",
        )
    with closing(parallel_env("merge", overrides={"map.changed_lanes": 9})) as env:
        env.reset(seed=1)
        with pytest.raises(ActionError, match=r"it is the last way out of \d roads, such as"):
            env.close_road("main_out")
        env.close_road("main_out", shuts_in=True)
        env.step(env.suggest_actions())
