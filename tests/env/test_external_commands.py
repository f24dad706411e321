"""Vehicles that the caller poses or drives: motion, visibility, and saved states.

Such vehicles are the same, bit for bit, in a divided and in an undivided world.
"""

from __future__ import annotations

import math
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
import pytest

from cavmarl import ActionError, CapacityError, CavEnv, ConfigError, parallel_env
from cavmarl.core.errors import EpisodeError
from cavmarl.core.records.codes import DRIVER_BACKGROUND, DRIVER_EXTERNAL
from cavmarl.core.records.rows import LOST_M
from tests.support.acted_on import hashes_of
from tests.support.saved_midway import check_resumed

ROOM = {"population.external": 4}


def place_on(env: Any, k: int, along_m: float = 0.0) -> tuple[float, float, float]:
    """Return x, y and heading of a place on the k-th long lane.

    `along_m` is measured from the start of the longest straight part of the lane.
    """
    roads = np.flatnonzero(~env.network.lanes["internal"] & (env.network.lanes["length_m"] > 40.0))
    line = env.network.lane_polyline(int(roads[k]))[:, :2]
    parts = np.diff(line, axis=0)
    longest = int(np.argmax(np.hypot(*parts.T)))
    heading = math.atan2(parts[longest, 1], parts[longest, 0])
    x, y = line[longest] + along_m * np.array([math.cos(heading), math.sin(heading)])
    return float(x), float(y), heading


def row_of(env: CavEnv, slot: int) -> np.void:
    rows = env.simulation.vehicles(0)
    row: np.void = rows[rows["id"] == env.external.ids()[slot]][0]
    return row


def advance(env: Any, steps: int = 1) -> None:
    for _ in range(steps):
        env.step(env.suggest_actions())


def act(env: Any, step: int) -> None:
    """Spawn, drive, pose or remove vehicles if this is planned for the step.

    Vehicle 1 is posed along a line, later with jumps, and then driven.
    """
    min_x, min_y, max_x, max_y = env.network.extent_m
    middle_x, middle_y = 0.5 * (min_x + max_x), 0.5 * (min_y + max_y)
    if step == 1:
        assert env.external.spawn(middle_x - 20.0, middle_y + 7.0, 0.0, speed=15.0) == 0
        assert env.external.spawn(middle_x + 3.0, middle_y - 15.0, math.pi / 2, vtype="bus") == 1
        assert env.external.spawn(*place_on(env, 3, 12.0), speed=8.0) == 2
        env.external.drive(0, 1.0, 0.0)
    if step == 4:
        env.external.drive(2, -0.5, 0.02)
    if 2 < step < 20:
        env.external.pose(1, middle_x + 3.0, middle_y - 15.0 + 2.0 * step, math.pi / 2)
    if step == 20:
        x, y, heading = place_on(env, 0, 10.0)
        env.external.pose(1, x, y, heading, speed=3.0)
    if step == 24:
        x, y, heading = place_on(env, -1, 10.0)
        env.external.pose(1, x, y, heading)
        env.external.drive(0, 0.5, -0.1)
    if step == 28:
        env.external.remove(2)
        env.external.drive(1, 1.5, 0.0)
    if step == 30:
        assert env.external.spawn(*place_on(env, 5, 20.0), size_m=(2.0, 0.7, 1.5)) == 2
    if step == 34:
        env.external.pose(0, middle_x, middle_y, 0.3, z=0.2, pitch=0.1)


hashes = partial(hashes_of, act=act, overrides=ROOM, agents=3, background=20, steps=45, every=4)


def test_a_divided_world_equals_the_undivided_one() -> None:
    undivided = hashes()
    assert hashes(zones=2) == undivided
    assert hashes(zones=3) == undivided
    assert hashes(zones=4, workers=2) == undivided


@pytest.mark.filterwarnings("ignore:workers = ")
def test_a_successor_of_a_dead_worker_continues() -> None:
    assert hashes(zones=4, workers=2, kill_at=(5, 21, 29)) == hashes()


@pytest.mark.slow
def test_worlds_over_nodes_equal_the_undivided_one() -> None:
    undivided = hashes()
    assert hashes(zones=2, nodes=2) == undivided
    assert hashes(zones=3, nodes=2, kill_at=(24,)) == undivided


def test_unused_slots_for_external_vehicles_change_no_result() -> None:
    found = []
    for overrides in ({}, ROOM):
        with closing(parallel_env("ring", agents=1, background=8, overrides=overrides)) as env:
            env.reset(seed=2)
            advance(env, 30)
            rows = env.simulation.vehicles(0)
            found.append((rows["id"].tolist(), rows["x"].tolist(), rows["speed"].tolist()))
    assert found[0] == found[1]


def ring(**more: Any) -> CavEnv:
    env = parallel_env("ring", agents=1, background=8, overrides=ROOM, **more)
    env.reset(seed=1)
    return env


def test_a_vehicle_stands_where_it_enters_until_it_is_driven() -> None:
    with closing(ring()) as env:
        x, y, heading = place_on(env, 0)
        slot = env.external.spawn(x, y, heading)
        assert (env.external.ids() == -1).all()
        advance(env)
        row = row_of(env, slot)
        assert (row["driver"], row["x"], row["y"], row["heading"]) == (
            DRIVER_EXTERNAL, x, y, heading,
        )  # fmt: skip
        assert row["speed"] == 0.0
        assert abs(row["d"]) < 0.01
        env.external.drive(slot, 2.0, 0.0)
        advance(env, 10)
        row = row_of(env, slot)
        seconds = 10 * env.step_s
        assert row["speed"] == pytest.approx(2.0 * seconds)
        assert math.hypot(row["x"] - x, row["y"] - y) == pytest.approx(seconds**2, abs=0.2)
        assert row["accel"] == pytest.approx(2.0)
        env.external.drive(slot, -4.0, 0.0)
        advance(env, 10)
        assert row_of(env, slot)["speed"] == 0.0


def test_a_posed_vehicle_reaches_its_pose_at_the_end_of_the_step() -> None:
    with closing(ring()) as env:
        x, y, heading = place_on(env, 0)
        slot = env.external.spawn(x, y, heading)
        advance(env)
        vehicle = env.external.ids()[slot]
        ahead = x + math.cos(heading), y + math.sin(heading)
        env.external.pose(slot, *ahead, heading, pitch=0.02, z=0.3)
        advance(env)
        row = row_of(env, slot)
        assert (row["id"], row["x"], row["y"], row["pitch"], row["z"]) == (
            vehicle, *ahead, 0.02, 0.3,
        )  # fmt: skip
        assert row["speed"] == pytest.approx(1.0 / env.step_s)
        advance(env)
        assert row_of(env, slot)["speed"] == 0.0
        assert (row_of(env, slot)["x"], row_of(env, slot)["y"]) == ahead


def test_a_vehicle_that_jumps_gets_a_new_id_and_is_not_counted_as_a_trip() -> None:
    with closing(ring()) as env:
        before = env.traffic_stats()
        slot = env.external.spawn(*place_on(env, 0))
        advance(env)
        first = env.external.ids()[slot]
        x, y, heading = place_on(env, 2)
        env.external.pose(slot, x, y, heading)
        advance(env)
        assert env.external.ids()[slot] > first
        assert (row_of(env, slot)["x"], row_of(env, slot)["y"]) == (x, y)
        env.external.remove(slot)
        advance(env)
        assert (env.external.ids() == -1).all()
        assert DRIVER_EXTERNAL not in env.simulation.vehicles(0)["driver"]
        after = env.traffic_stats()
        for name in ("arrived", "removed", "departed", "running"):
            assert after[name] == before[name], name


def test_drivers_stop_behind_a_vehicle_on_their_lane_and_pass_a_vehicle_beside_the_road() -> None:
    standing = []
    for aside_m in (0.0, 25.0):
        with closing(ring()) as env:
            x, y, heading = place_on(env, 0)
            x += aside_m * math.sin(-heading)
            y += aside_m * math.cos(heading)
            slot = env.external.spawn(x, y, heading)
            advance(env, 50)
            row, rows = row_of(env, slot), env.simulation.vehicles(0)
            assert (row["hit"], abs(row["d"]) > LOST_M) == (-1, aside_m > 0.0)
            drivers = rows[rows["driver"] == DRIVER_BACKGROUND]
            standing.append(int((drivers["speed"] == 0.0).sum()))
    assert standing == [1, 0]


def test_a_contact_counts_for_both_vehicles() -> None:
    with closing(ring()) as env:
        slot = env.external.spawn(*place_on(env, 0))
        advance(env)
        agent = env.simulation.vehicles(0)
        agent = agent[agent["agent"] == 0][0]
        env.external.pose(slot, float(agent["x"]), float(agent["y"]), float(agent["heading"]))
        advance(env, 2)
        assert row_of(env, slot)["hit"] == agent["id"]


def test_invalid_commands_are_refused_with_a_remedy() -> None:
    with closing(parallel_env("ring", agents=1, background=8)) as env:
        env.reset(seed=0)
        with pytest.raises(ConfigError, match=r"set population\.external"):
            env.external.spawn(0.0, 0.0, 0.0)
        with pytest.raises(ConfigError, match=r"set population\.external"):
            env.external.ids()
    with closing(parallel_env("ring", agents=1, background=8, overrides=ROOM)) as env:
        with pytest.raises(EpisodeError, match="before reset"):
            env.external.spawn(0.0, 0.0, 0.0)
        env.reset(seed=1)
        x, y, heading = place_on(env, 0)
        with pytest.raises(ActionError, match="outside of the map"):
            env.external.spawn(x + 10_000.0, y, heading)
        with pytest.raises(ActionError, match="must be a finite number"):
            env.external.spawn(math.nan, y, heading)
        with pytest.raises(ActionError, match="must be one of car, truck, bus"):
            env.external.spawn(x, y, heading, vtype="tank")
        with pytest.raises(ActionError, match="at most those of a bus"):
            env.external.spawn(x, y, heading, size_m=(30.0, 2.0, 2.0))
        with pytest.raises(ActionError, match="must be from -60 to 60"):
            env.external.spawn(x, y, heading, speed=70.0)
        with pytest.raises(ActionError, match="must be from 0 to 0"):
            env.external.spawn(x, y, heading, world=1)
        slot = env.external.spawn(x, y, heading)
        with pytest.raises(ActionError, match="occupied"):
            env.external.spawn(x + 0.5, y, heading)
        advance(env)
        with pytest.raises(ActionError, match="occupied"):
            env.external.spawn(x + 0.5, y, heading)
        with pytest.raises(ActionError, match="must be a finite number"):
            env.external.drive(slot, math.inf, 0.0)
        for name in ("z", "pitch"):  # a saved state with such a number would be refused
            with pytest.raises(
                ActionError, match=rf"{name} = 1e\+300: must be a finite number from"
            ):
                env.external.pose(slot, x, y, heading, **{name: 1e300})
        with pytest.raises(ActionError, match="there is no such vehicle"):
            env.external.drive(slot + 1, 0.0, 0.0)
        with pytest.raises(ActionError, match="there is no such vehicle"):
            env.external.pose(-1, x, y, heading)
        with pytest.raises(ActionError, match="there is no such vehicle"):
            env.external.remove(4)
        env.external.remove(slot)
        with pytest.raises(ActionError, match="there is no such vehicle"):
            env.external.drive(slot, 0.0, 0.0)
        slots = [env.external.spawn(*place_on(env, k)) for k in (0, 1, 2)]
        assert slot not in slots
        with pytest.raises(CapacityError, match=r"population\.external are in use"):
            env.external.spawn(*place_on(env, 3))
        advance(env)
        env.external.spawn(*place_on(env, 3))
        env.reset(seed=1)
        with pytest.raises(ActionError, match="there is no such vehicle"):
            env.external.drive(slots[0], 0.0, 0.0)
        assert env.external.spawn(x, y, heading) == 0
    with pytest.raises(ConfigError, match=r"population\.external = 3: .*needs a single map"):
        parallel_env("cities", overrides={"population.external": 3})


def test_saved_states_include_external_vehicles_and_waiting_commands() -> None:
    check_resumed(act, ROOM, at=24, steps=40)


def test_sensors_messages_and_moving_borders_change_no_result() -> None:
    more = {"v2x.enabled": True, "rig": {"lidar": {"type": "lidar", "rate_hz": 5, "rays": 24}}}
    undivided = hashes(overrides=ROOM | more)
    moving = {**more, "zones.repartition_steps": 6, "zones.check_invariants": True}
    assert hashes(overrides=ROOM | moving, zones=3) == undivided
