"""Followers on the target lane brake for a vehicle that has to change lanes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.arrays import Scratch
from cavmarl.driving.kernels.lanes.cooperative_braking import brake_for_merging
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.vehicles import VEHICLE
from tests.support.traffic import network, scratch, travel

NAME = "grid4x4"
FREE = 2.0  # m/s², acceleration without cooperative braking


def crossing() -> tuple[int, int, list[int]]:
    """Return a lane, its left neighbour, and the lanes that lead to this neighbour."""
    roads = network(NAME)
    for lane, row in enumerate(roads.lanes):
        left = int(row["left"])
        if left >= 0 and not row["internal"] and roads.lanes["num_into"][left] > 1:
            first = roads.lanes["first_into"][left]
            return lane, left, roads.into[first : first + roads.lanes["num_into"][left]].tolist()
    raise AssertionError("no lane with a neighbour that two lanes lead to")


def merged(rows: NDArray[np.void]) -> Scratch:
    """Return the scratch arrays after cooperative braking for row 0, with each row's `accel`."""
    roads, ways = network(NAME), travel(NAME)
    room = scratch(roads, len(rows))
    room.accel[: len(rows)] = FREE
    index_lanes(roads.arrays, ways, rows, len(rows), room)
    brake_for_merging(roads.arrays, ways, rows, rows[0], room)
    return room


def rows_on(places: list[tuple[int, float]], speed: float = 10.0) -> NDArray[np.void]:
    """Return cars at (lane, s); the first car signals a change to the left."""
    rows = np.zeros(len(places), VEHICLE)
    rows["id"], rows["side_lane"] = np.arange(len(places)), -1
    rows["lane"], rows["s"] = zip(*places, strict=True)
    rows["length"], rows["speed"], rows["speed_factor"] = 5.0, speed, 1.0
    rows["speed"][0], rows["blinker"][0] = 1.0, 1
    return rows


@pytest.mark.parametrize("id_", [0, 1])
def test_followers_on_all_incoming_lanes_brake(id_: int) -> None:
    lane, _, before = crossing()
    rows = rows_on([(lane, 6.0), (before[id_], 1.0), (before[1 - id_], 2.0)])
    assert (merged(rows).accel[1:3] < FREE).all()


def test_only_the_follower_on_the_target_lane_brakes_if_there_is_one() -> None:
    lane, left, before = crossing()
    rows = rows_on([(lane, 20.0), (left, 8.0), (before[0], 1.0)])
    accel = merged(rows).accel
    assert accel[1] < FREE
    assert accel[2] == FREE


def test_only_the_first_vehicle_of_an_incoming_lane_brakes() -> None:
    lane, _, before = crossing()
    length = float(network(NAME).lanes["length_m"][before[0]])
    rows = rows_on([(lane, 12.0), (before[0], 0.0), (before[0], length - 1.0)])
    accel = merged(rows).accel
    assert accel[2] < FREE
    assert accel[1] == FREE


def test_no_follower_brakes_for_a_distant_vehicle() -> None:
    lane, left, _ = crossing()
    rows = rows_on([(lane, 75.0), (left, 10.0)])
    assert merged(rows).accel[1] == FREE
