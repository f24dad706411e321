"""How steered cars (agents) approach lane ends, and leaders whose bodies are still over a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    HOLD_SIGNAL,
    SIGNAL_RED,
)
from cavmarl.driving.kernels.drivers import decide
from cavmarl.driving.kernels.junctions.gaps import link_signal
from cavmarl.driving.kernels.lanes.adjacent_leaders import behind_askew
from cavmarl.driving.kernels.lanes.lane_ends import (
    LONGEST_HALF_M,
    behind_over_line,
    behind_turning,
    misses_last_change,
)
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.kernels.models.following import no_constraint
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.roads.routing import PLAN
from tests.support.dead_ends import before_dead_end, put
from tests.support.driving import suggested
from tests.support.traffic import network, on_lane, scratch, travel


def test_a_steered_car_that_must_still_change_lanes_brakes_before_the_lane_end(
    tmp_path: Path,
) -> None:
    world, right, left, goal = before_dead_end(tmp_path, length_m=200.0)
    roads, plans, tables = world.network, world.plans, world.travel
    way = goal * len(roads.lanes)
    assert plans["change"][goal, right] == 1
    assert plans["link"][goal, right] >= 0, "the lane of the car has no link"
    assert [misses_last_change(roads.arrays, tables, lane, way) for lane in (right, left)] == [1, 0]
    inside = int(roads.links["first_internal"][plans["link"][goal, right]])
    assert not misses_last_change(roads.arrays, tables, inside, way)

    rows = world.vehicles(0)  # two cars side by side before the lane end
    end = float(roads.lanes["length_m"][right])
    for row, lane in zip(rows, (right, left), strict=True):
        put(world, row, lane, end - 16.0, 8.0, goal)
    throttle = suggested(world)[0, rows["agent"], 0]
    assert throttle[0] < -0.5
    assert throttle[1] > throttle[0]


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_steered_car_waits_at_the_lane_end_until_its_front_is_on_the_adjacent_lane(
    tmp_path: Path, speed: float
) -> None:
    world, right, _, goal = before_dead_end(tmp_path, length_m=200.0)
    rows = world.vehicles(0)
    end = float(world.network.lanes["length_m"][right])
    width_m = float(world.network.lanes["width_m"][right])
    found = []
    for share in (0.2, 0.3):  # offset to the left, in lane widths
        put(world, rows[0], right, end - 2.6, speed, goal)
        put(world, rows[1], right, 20.0, 0.0, goal)
        rows[0]["d"] = share * width_m
        found.append(float(suggested(world)[0, rows["agent"][0], 0]))
    assert found[0] <= 0.0
    assert found[1] > 0.0


def test_a_steered_car_changes_lanes_slowly_near_the_end_of_its_lane(tmp_path: Path) -> None:
    """A faster car would not complete the change before the end of the lane."""
    world, right, _, goal = before_dead_end(tmp_path, length_m=200.0)
    rows = world.vehicles(0)
    end = float(world.network.lanes["length_m"][right])
    for to_end_m, speed, faster in ((6.0, 0.9, True), (4.9, 0.3, True), (4.9, 0.9, False)):
        put(world, rows[0], right, end - to_end_m, speed, goal)
        put(world, rows[1], right, 20.0, 0.0, goal)
        throttle, steering = suggested(world)[0, rows["agent"][0]]
        assert steering > 0.0
        assert (throttle > 0.0) == faster


@pytest.mark.parametrize("over_m", [0.5, -0.5])
def test_a_vehicle_beyond_a_short_lane_is_a_leader_if_its_rear_is_before_the_line(
    over_m: float,
) -> None:
    roads, tables = network("grid4x4"), travel("grid4x4")
    inside = np.where(roads.lanes["internal"], roads.lanes["length_m"], np.inf)
    first = int(inside.argmin())
    length = float(roads.lanes["length_m"][first])
    assert length < LONGEST_HALF_M
    beyond = int(roads.lanes["successor"][first])
    before = int(roads.arrays.into[roads.lanes["first_into"][first]])
    half = length + 1.0 + over_m
    rows = np.concatenate(
        [on_lane(roads, before, 10.0, tables, id=0, speed=8.0, driver=DRIVER_AGENT),
         on_lane(roads, beyond, 1.0, tables, id=1, length=2.0 * half)]
    )  # fmt: skip
    room = scratch(roads, 2)
    index_lanes(roads.arrays, tables, rows, 2, room)
    kind = generated_types()[0]
    found = behind_over_line(
        roads.arrays, tables, rows[0], kind, first, int(rows["way"][0]), 20.0, room
    )
    assert (found > no_constraint(kind)) == (over_m > 0.0)


@pytest.mark.parametrize("over_m", [0.5, -0.5])
def test_a_vehicle_that_stops_at_a_line_keeps_a_gap_to_a_rear_over_the_line(over_m: float) -> None:
    roads, tables = network("grid4x4"), travel("grid4x4")
    inside = np.where(roads.lanes["internal"], roads.lanes["length_m"], np.inf)
    first = int(inside.argmin())
    link = int(roads.lanes["link"][first])
    before, beyond = int(roads.links["from_lane"][link]), int(roads.lanes["successor"][first])
    end_m = float(roads.lanes["length_m"][before])
    half = float(roads.lanes["length_m"][first]) + 1.0 + over_m
    rows = np.concatenate(
        [on_lane(roads, before, end_m - 4.5, tables, id=0, speed=1.0),
         on_lane(roads, beyond, 1.0, tables, id=1, length=2.0 * half)]
    )  # fmt: skip
    room, step = scratch(roads, 2), np.zeros(2, PLAN)
    step["next"], step["link"] = (first, -1), (link, -1)
    index_lanes(roads.arrays, tables, rows, 2, room)
    room.link_start[:] = room.link_end[:] = 0  # no vehicle is on the junction
    signal, index = roads.links["signal"][link], roads.links["signal_index"][link]
    letters = roads.phase_states[roads.phases["first_state"] + index]
    phase = np.full(len(roads.signals), int((letters == SIGNAL_RED).argmax()), np.int32)
    assert link_signal(roads.arrays, link, phase) == SIGNAL_RED, signal
    decide(roads.arrays, tables, rows, 2, DRIVER_BACKGROUND, 0, 0.1, phase, step, room)
    alone = scratch(roads, 1)
    index_lanes(roads.arrays, tables, rows, 1, alone)
    alone.link_start[:] = alone.link_end[:] = 0
    decide(roads.arrays, tables, rows, 1, DRIVER_BACKGROUND, 0, 0.1, phase, step, alone)
    assert room.hold[0] == alone.hold[0] == HOLD_SIGNAL
    assert (room.accel[0] < alone.accel[0]) == (over_m > 0.0)


@pytest.mark.parametrize(("length_m", "over_m", "minds"), [
    (12.0, 2.0, True), (12.0, -1.0, False), (12.0, 13.0, False), (5.0, 2.0, False),
])  # fmt: skip
def test_vehicles_on_an_ending_lane_follow_a_long_vehicle_that_turns_from_the_adjacent_lane(
    length_m: float, over_m: float, minds: bool
) -> None:
    """`over_m`: distance of the long vehicle's front beyond the line. Its rear swings out."""
    roads, tables = network("merge"), travel("merge")
    lanes = roads.lanes.copy()
    leads = (lanes["num_links"] > 0) & (lanes["left"] >= 0)
    lane = next(int(k) for k in np.flatnonzero(leads) if lanes["num_links"][lanes["left"][k]] > 0)
    beside = int(lanes["left"][lane])
    lanes["num_links"][lane] = 0
    row = on_lane(roads, lane, 10.0, tables, id=0, speed=8.0)[0]
    room = scratch(roads, 2)
    room.link_start[:] = room.link_end[:] = 0
    link = int(roads.lanes["first_link"][beside])
    room.link_end[link] = 1
    room.approach["half"][0] = 0.5 * length_m
    room.approach["dist"][0] = 0.5 * length_m - over_m
    kind = generated_types()[0]
    found = behind_turning(roads.arrays._replace(lanes=lanes), kind, row, lane, 20.0, room)
    assert (found > no_constraint(kind)) == minds


@pytest.mark.parametrize(("askew", "hidden"), [(0.5, False), (0.5, True), (0.0, False)])
def test_a_car_askew_that_reaches_over_from_the_adjacent_lane_is_a_leader(
    askew: float, hidden: bool
) -> None:
    """With `hidden`, another car stands behind that car, straight on the adjacent lane."""
    roads, tables = network("merge"), travel("merge")
    lane = roads.lane_ids.index("weave_1")
    before = int(roads.arrays.into[roads.lanes["first_into"][lane]])
    rows = np.concatenate(
        [on_lane(roads, before, 10.0, tables, id=0, speed=8.0, driver=DRIVER_AGENT),
         on_lane(roads, int(roads.lanes["left"][lane]), 16.0, tables, id=1, driver=DRIVER_AGENT),
         on_lane(roads, int(roads.lanes["left"][lane]), 6.0, tables, id=2, driver=DRIVER_AGENT)]
    )[: 3 if hidden else 2]  # fmt: skip
    rows["heading"][1] += askew
    room = scratch(roads, 3)
    index_lanes(roads.arrays, tables, rows, len(rows), room)
    kind = generated_types()[0]
    found = behind_askew(roads.arrays, tables, rows, kind, rows[0], lane, -20.0, room)
    assert (found > no_constraint(kind)) == (askew > 0.0)
    far = behind_askew(roads.arrays, tables, rows, kind, rows[0], lane, -tables.view_m, room)
    assert far == no_constraint(kind)
