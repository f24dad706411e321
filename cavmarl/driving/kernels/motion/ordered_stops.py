"""Ordered stops: bus stops, deliveries and other stops in a demand file."""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.arrays import RoadArrays, TripTables
from cavmarl.core.records.codes import UNTIL_DEPARTURE

STANDING_MPS = 0.1
STOPPED_M = 3.0  # a vehicle is at a stop if its front is at most this far before the stop
PASSED_M = 1.0  # a vehicle has missed a stop if its front is this far beyond the stop
STAY = 2  # result of `change_for_stop`: the vehicle is on the lane of the stop
LANE_EARLY_M = 100.0  # distance before a stop at which the driver changes to the stop's lane


@inlined_kernel
def distance_to_stop(roads: RoadArrays, travel: TripTables, row: np.void) -> float:
    """Return the distance in m from a vehicle's front to its next stop on this edge, or inf.

    The result is also inf if the vehicle has passed the stop.
    """
    if row["stop"] < 0 or row["stop"] == row["stops_end"]:
        return np.inf
    stop = travel.stops[row["stop"]]
    lane = roads.lanes[row["lane"]]
    place = roads.lanes[stop["lane"]]
    if place["edge"] != lane["edge"]:
        return np.inf
    left = float(
        stop["end"] * lane["length_m"] / place["length_m"] - row["s"] - 0.5 * row["length"]
    )
    return left if left > -PASSED_M else np.inf


@inlined_kernel
def change_for_stop(roads: RoadArrays, travel: TripTables, row: np.void) -> int:
    """Return the side to which a vehicle has to change for its next stop: 1 left, -1 right, 0 none.

    The result is `STAY` if the vehicle is already on the lane of the stop.
    """
    if distance_to_stop(roads, travel, row) > LANE_EARLY_M:
        return 0
    stop = travel.stops[row["stop"]]
    if stop["lane"] == row["lane"]:
        return STAY
    inwards = 1 if stop["lane"] > row["lane"] else -1
    # Lanes are numbered from the kerb: in left-hand traffic the next lane is to the right.
    here = roads.lanes[row["lane"]]
    mirrored = here["right"] == row["lane"] + 1 or here["left"] == row["lane"] - 1
    return -inwards if mirrored else inwards


@inlined_kernel
def advance_stop(
    roads: RoadArrays,
    travel: TripTables,  # with the stops
    row: np.void,  # VEHICLE after the tick, written
    lane_before: int,  # LANE of the vehicle before the tick
    dt: float,  # length of a tick, s
) -> None:
    """Add the tick to the time that a vehicle has spent at its stop, and end the stop when due.

    A stop that the vehicle has passed is skipped.
    """
    if row["stop"] < 0 or row["stop"] == row["stops_end"]:
        return
    stop = travel.stops[row["stop"]]
    edge = roads.lanes[stop["lane"]]["edge"]
    left = distance_to_stop(roads, travel, row)
    if left <= STOPPED_M and row["speed"] < STANDING_MPS:
        row["stopped_s"] += dt
        row["wait_s"] = 0.0
        now = travel.begin_s + row["tick"] * dt
        until = stop["until"]
        if until >= 0.0 and stop["until_from"] == UNTIL_DEPARTURE:
            until += travel.begin_s + row["departed"] * dt
        if row["stopped_s"] >= stop["duration"] and now >= until:
            row["stop"] += 1
            row["stopped_s"] = 0.0
    elif roads.lanes[lane_before]["edge"] == edge and left == np.inf:
        row["stop"] += 1
        row["stopped_s"] = 0.0
