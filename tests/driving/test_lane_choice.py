"""Where lane changes are possible and safe, and which vehicles they depend on."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND, MODEL_KRAUSS
from cavmarl.driving.kernels.lanes.lane_choice import (
    MAX_BRAKING_NEEDED,
    MERGE_ROOM_M,
    SWAP_ROOM_M,
    change_is_safe,
    imposed_on_followers,
    rear_is_inside,
    room_for_further_changes,
    wish_on_lane,
)
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.vehicle_types import generated_types, set_model
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.roads.network import LANE
from cavmarl.roads.routing import PLAN
from tests.support.traffic import network, on_lane, scratch, travel


@pytest.mark.parametrize(
    ("changes", "length_m", "room_m"),
    [
        (1, 100.0, 0.0),
        (2, 100.0, 5.0 + SWAP_ROOM_M),
        (3, 100.0, 2.0 * (5.0 + SWAP_ROOM_M)),
        (3, 40.0, 0.25 * 40.0 - MERGE_ROOM_M),  # limited to a quarter of the lane
        (3, 4.0, 0.0),
    ],
)
def test_each_further_lane_change_needs_more_room(
    changes: int, length_m: float, room_m: float
) -> None:
    lane, step = np.zeros(1, LANE)[0], np.zeros(1, PLAN)[0]
    lane["length_m"], step["changes"] = length_m, changes
    assert room_for_further_changes(lane, blank_vehicle()[0], step) == pytest.approx(room_m)


@pytest.mark.parametrize(("view_m", "minds"), [(100.0, True), (60.0, False)])
def test_a_leader_beyond_the_view_is_ignored(view_m: float, minds: bool) -> None:
    """A zone may not know a leader that is so far away, so drivers must ignore it in any world."""
    roads = network("merge")
    tables = travel("merge")._replace(view_m=view_m)
    lane = int(roads.lanes["length_m"].argmax())
    length_m = float(roads.lanes["length_m"][lane])
    assert length_m > 80.0
    places = (1.0, 78.0)
    rows = np.concatenate([on_lane(roads, lane, s, tables, id=k) for k, s in enumerate(places)])
    rows["speed"] = 12.0, 0.0
    wishes = []
    for num in (1, 2):
        room = scratch(roads, 2)
        index_lanes(roads.arrays, tables, rows, num, room)
        first = int(room.lane_start[lane])
        wishes.append(wish_on_lane(roads.arrays, tables, rows[0], first, room))
    assert (wishes[1] < wishes[0]) == minds


@pytest.mark.parametrize(
    ("driver", "length_m", "waits"),
    [
        (DRIVER_BACKGROUND, 4.0, False),
        (DRIVER_BACKGROUND, 11.2, False),
        (DRIVER_BACKGROUND, 14.4, False),
        (DRIVER_BACKGROUND, 14.6, True),
        (DRIVER_AGENT, 12.9, False),
        (DRIVER_AGENT, 13.1, True),
    ],
)
def test_a_vehicle_with_its_rear_in_the_junction_keeps_its_lane_unless_the_lane_is_short(
    driver: int, length_m: float, waits: bool
) -> None:
    """On a lane that is too short for two cars, the vehicle changes lanes where it waits."""
    lane, row = np.zeros(1, LANE)[0], blank_vehicle()[0]
    row["driver"] = driver
    lane["length_m"], row["length"], row["s"] = length_m, 5.0, 2.4
    assert rear_is_inside(lane, row) == waits
    row["s"] = 2.6
    assert not rear_is_inside(lane, row)


@pytest.mark.parametrize(("length_m", "near_m"), [(16.4, 0.0), (18.5, 2.0), (100.0, 5.0)])
def test_a_vehicle_keeps_its_lane_near_the_junction_behind_it(
    length_m: float, near_m: float
) -> None:
    lane, row = np.zeros(1, LANE)[0], blank_vehicle()[0]
    row["driver"], row["length"], lane["length_m"] = DRIVER_BACKGROUND, 5.0, length_m
    for rear_m, stays in ((near_m - 0.1, True), (near_m + 0.1, False)):
        row["s"] = 2.5 + rear_m
        assert rear_is_inside(lane, row) == stays


@pytest.mark.parametrize(
    ("driver", "speed", "stays"),
    [(DRIVER_AGENT, 1.1, True), (DRIVER_AGENT, 0.9, False), (DRIVER_BACKGROUND, 0.9, True)],
)
def test_a_slow_steered_vehicle_may_change_lanes_close_to_a_junction(
    driver: int, speed: float, stays: bool
) -> None:
    """The vehicle is 3 m behind a junction, on a lane of 20 m."""
    lane, row = np.zeros(1, LANE)[0], blank_vehicle()[0]
    row["driver"], row["length"], lane["length_m"] = driver, 5.0, 20.0
    row["s"], row["speed"] = 2.5 + 3.0, speed
    assert rear_is_inside(lane, row) == stays


@pytest.mark.parametrize(("far_mps", "asks"), [(25.0, True), (0.0, False)])
def test_a_lane_change_considers_followers_on_every_incoming_lane(
    far_mps: float, asks: bool
) -> None:
    """A fast vehicle counts although a standing vehicle on another incoming lane is nearer."""
    roads, tables = network("grid4x4"), travel("grid4x4")
    lane = int(roads.lanes["num_into"].argmax())
    first = int(roads.lanes["first_into"][lane])
    near, far = (int(k) for k in roads.arrays.into[first : first + 2])
    cars = [(lane, 6.0, 10.0), (near, float(roads.lanes["length_m"][near]) - 3.0, 0.0),
            (far, float(roads.lanes["length_m"][far]) - 8.0, far_mps)]  # fmt: skip
    rows = np.concatenate(
        [on_lane(roads, at, s, tables, id=k, speed=mps) for k, (at, s, mps) in enumerate(cars)]
    )
    room = scratch(roads, 3)
    index_lanes(roads.arrays, tables, rows, 3, room)
    least = imposed_on_followers(roads.arrays, tables, rows, rows[0], lane, 6.0, room)
    assert (least < -MAX_BRAKING_NEEDED) == asks


@pytest.mark.parametrize(("gap_m", "safe"), [(1.2, False), (2.0, True)])
def test_no_lane_change_ends_too_close_to_a_leader_at_low_speed(gap_m: float, safe: bool) -> None:
    """Lane changes also limit the braking that stops the car within the gap.

    Krauss's model spreads braking from 3.5 m/s over its reaction time of 1 s, so it never demands
    more than 3.5 m/s² of braking, however small the gap is.
    """
    roads, types = network("merge"), generated_types().copy()
    set_model(types, MODEL_KRAUSS)
    types["tau"] = 1.0
    tables = travel("merge")._replace(types=types)
    lane = int(np.flatnonzero(~roads.lanes["internal"] & (roads.lanes["left"] >= 0))[0])
    left = int(roads.lanes["left"][lane])
    cars = [(lane, 30.0, 3.5), (left, 35.0 + gap_m, 0.0)]
    rows = np.concatenate(
        [on_lane(roads, at, s, tables, id=k, speed=mps) for k, (at, s, mps) in enumerate(cars)]
    )
    room = scratch(roads, 2)
    index_lanes(roads.arrays, tables, rows, 2, room)
    assert change_is_safe(roads.arrays, tables, rows, 0, left, 0.0, True, room) == safe
