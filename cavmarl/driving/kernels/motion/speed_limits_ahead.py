"""Speed limits ahead: the allowed speed before a lower limit or a sharp bend."""

from __future__ import annotations

import math

import numpy as np

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import atan2
from cavmarl.core.records.arrays import RoadArrays

LIMIT_DECEL = 2.0  # m/s², deceleration before a bend or a lower limit
LIMIT_LEAD_S = 1.0  # the limit is reached this much earlier, because the model reacts late
LATERAL_ACCEL = 2.5  # m/s², lateral acceleration of a steered car in a bend
# A bend is a change of direction by more than `MIN_BEND_RAD` within `BEND_M`.
MIN_BEND_RAD = 0.2
BEND_M = 6.0


@kernel
def bend_speed(roads: RoadArrays, before: int, lane: int, distance: float) -> float:
    """Return the largest present speed in m/s at which a steered car can take a lane's bends.

    `distance` is the distance in m to the start of the lane, negative on the lane. `before` is the
    previous lane or, if the car is on the lane, the lane itself.
    """
    row = roads.lanes[lane]
    first = row["first_point"]
    last = first + row["num_points"] - 1
    slowest = math.inf
    for k in range(first if before != lane else first + 1, last):
        to_bend = distance + roads.points[k]["s"]
        if to_bend < -BEND_M:
            continue
        straight = roads.points[k - 1]
        if k == first:
            straight = roads.points[
                roads.lanes[before]["first_point"] + roads.lanes[before]["num_points"] - 1
            ]
        m = k
        while m < last - 1 and roads.points[m + 1]["s"] - roads.points[k]["s"] < BEND_M:
            m += 1
        after = roads.points[m]
        bend = abs(
            atan2(
                straight["cos"] * after["sin"] - straight["sin"] * after["cos"],
                straight["cos"] * after["cos"] + straight["sin"] * after["sin"],
            )
        )
        if bend > MIN_BEND_RAD:
            squared = LATERAL_ACCEL * BEND_M / bend + 2.0 * LIMIT_DECEL * max(to_bend, 0.0)
            slowest = min(slowest, math.sqrt(squared))
    return slowest


@inlined_kernel
def speed_before_limit(
    kind: np.void, limit: float, distance: float, speed: float, dt: float
) -> float:
    """Return the highest speed in m/s that can be reduced to a limit `distance` m ahead."""
    decel = LIMIT_DECEL
    lead_s = LIMIT_LEAD_S
    if kind["as_sumo"]:
        decel = kind["decel"]
        lead_s = dt
    return math.sqrt(limit * limit + 2.0 * decel * max(distance - lead_s * speed, 0.0))
