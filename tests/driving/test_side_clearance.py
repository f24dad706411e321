"""A slow vehicle changes lanes beside a vehicle that stands askew."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.records.codes import DRIVER_BACKGROUND
from cavmarl.driving.kernels.drivers import decide
from cavmarl.driving.kernels.junctions.approach import register_links
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.kernels.lanes.side_clearance import (
    STAYS_ASIDE,
    has_side_clearance,
    has_to_stay_aside,
)
from cavmarl.driving.kernels.motion.motion import move_background
from cavmarl.roads.routing import PLAN
from tests.support.traffic import network, on_lane, scratch, travel

LEFT, RIGHT = 1, -1


def lanes() -> list[int]:
    """Return three adjacent lanes, from right to left."""
    roads = network("merge")
    return [roads.lane_ids.index(f"weave_{k}") for k in range(3)]


@pytest.mark.parametrize(
    ("beyond", "askew_rad", "speed", "room"),
    [(1, 0.3, 0.0, False), (1, 0.0, 0.0, True), (1, 0.3, 1.0, True), (0, 0.3, 0.0, True)],
)
def test_a_corner_of_a_standing_bus_over_the_target_lane_leaves_no_room(
    beyond: int, askew_rad: float, speed: float, room: bool
) -> None:
    """If `beyond` is 1, the bus is on the lane beyond the target lane, else on the car's lane."""
    roads, tables = network("merge"), travel("merge")
    right, middle, left = lanes()
    own = on_lane(roads, right, 40.0, tables, id=0, length=5.0, width=1.8)
    at = (right, left)[beyond]
    place_m = (36.0, 42.0)[beyond]
    bus = on_lane(roads, at, place_m, tables, id=1, length=12.0, width=2.5, speed=speed)
    bus["heading"] += askew_rad
    rows = np.concatenate([own, bus])
    index = scratch(roads, 2)
    index_lanes(roads.arrays, tables, rows, 2, index)
    assert has_side_clearance(roads.arrays, rows, rows[0], middle, 40.0, 0.0, LEFT, index) == room


@pytest.mark.parametrize(
    ("d", "speed", "stays"),
    [
        (-1.0, 0.0, False),
        (-0.1, 0.0, True),
        (-0.1, 4.9, True),
        (-0.1, 5.1, False),
        (0.0, 0.0, False),
    ],
)
def test_a_vehicle_between_lanes_stops_moving_sideways_before_it_touches_a_corner(
    d: float, speed: float, stays: bool
) -> None:
    """The car moves from the right lane to the middle one; a corner of a bus is over that lane."""
    roads, tables = network("merge"), travel("merge")
    _, middle, left = lanes()
    own = on_lane(roads, middle, 40.0, tables, id=0, length=5.0, width=1.8, d=d, speed=speed,
                  driver=DRIVER_BACKGROUND)  # fmt: skip
    bus = on_lane(roads, left, 42.0, tables, id=1, length=12.0, width=2.5, speed=0.0)
    bus["heading"] += 0.2
    rows = np.concatenate([own, bus])
    rows["side_lane"] = -1
    index, step = scratch(roads, 2), np.zeros(2, PLAN)
    index_lanes(roads.arrays, tables, rows, 2, index)
    assert has_to_stay_aside(roads.arrays, rows, rows[0], index) == stays
    register_links(roads.arrays, tables, rows, 2, step, np.zeros(2, np.int64), index)
    phase = np.zeros(len(roads.signals), np.int32)
    decide(roads.arrays, tables, rows, 2, DRIVER_BACKGROUND, 0, 0.1, phase, step, index)
    assert (index.lane_change[0] == STAYS_ASIDE) == stays
    change = int(index.lane_change[0])
    move_background(roads.arrays, tables, rows[0], step[0], 0.0, change, 0.1)
    assert (rows["d"][0] == d) == (stays or d == 0.0)
