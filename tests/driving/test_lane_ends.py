"""What the end of a lane asks of a steered vehicle, and what is still over a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.driving.kernels.beside import behind_askew
from cavmarl.driving.kernels.following import no_constraint
from cavmarl.driving.kernels.lane_ends import LONGEST_HALF_M, behind_over_line, misses_change
from cavmarl.driving.kernels.lane_index import index_lanes
from cavmarl.driving.vehicle_types import generated_types
from tests.support.dead_ends import before_dead_end, put
from tests.support.driving import suggested
from tests.support.traffic import network, on_lane, scratch, travel


def test_a_steered_car_stops_before_the_end_of_a_lane_to_a_turn_that_it_cannot_take(
    tmp_path: Path,
) -> None:
    world, right, left, goal = before_dead_end(tmp_path, length_m=200.0)
    roads, plans, tables = world.network, world.plans, world._tick.traffic.travel
    way = goal * len(roads.lanes)
    assert plans["change"][goal, right] == 1
    assert plans["link"][goal, right] >= 0, "its lane goes on, too"
    assert [misses_change(roads.arrays, tables, lane, way) for lane in (right, left)] == [1, 0]
    inside = int(roads.links["first_internal"][plans["link"][goal, right]])
    assert not misses_change(roads.arrays, tables, inside, way)

    rows = world.vehicles(0)  # side by side before the end
    end = float(roads.lanes["length_m"][right])
    for row, lane in zip(rows, (right, left), strict=True):
        put(world, row, lane, end - 16.0, 8.0, goal)
    throttle = suggested(world)[0, rows["agent"], 0]
    assert throttle[0] < -0.5
    assert throttle[1] > throttle[0]


@pytest.mark.parametrize("over_m", [0.5, -0.5])
def test_a_rear_over_the_line_is_a_leader_behind_a_short_first_lane(over_m: float) -> None:
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


@pytest.mark.parametrize("askew", [0.5, 0.0])
def test_a_car_that_sticks_out_beyond_the_border_of_a_lane_is_a_leader(askew: float) -> None:
    roads, tables = network("merge"), travel("merge")
    lane = roads.lane_ids.index("weave_1")
    before = int(roads.arrays.into[roads.lanes["first_into"][lane]])
    rows = np.concatenate(
        [on_lane(roads, before, 10.0, tables, id=0, speed=8.0, driver=DRIVER_AGENT),
         on_lane(roads, int(roads.lanes["left"][lane]), 6.0, tables, id=1, driver=DRIVER_AGENT)]
    )  # fmt: skip
    rows["heading"][1] += askew
    room = scratch(roads, 2)
    index_lanes(roads.arrays, tables, rows, 2, room)
    kind = generated_types()[0]
    found = behind_askew(roads.arrays, tables, rows, kind, rows[0], lane, -20.0, room)
    assert (found > no_constraint(kind)) == (askew > 0.0)
    far = behind_askew(roads.arrays, tables, rows, kind, rows[0], lane, -tables.view_m, room)
    assert far == no_constraint(kind)
