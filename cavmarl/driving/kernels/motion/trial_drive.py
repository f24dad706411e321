"""Trial drives of a car with the built-in driver's steering: whether it stays on its road."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cos_sin
from cavmarl.core.math.geometry import lane_pose, project
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import LaneGrid, RoadArrays
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from cavmarl.driving.kernels.motion.steering import steer_to_lane
from cavmarl.driving.kernels.motion.tracking import locate

TRIAL_MPS = 3.5  # approximate speed in sharp bends
FASTER_MPS = 4.2  # approximate speed in bends of 90°
TRIAL_DT_S = 0.1
SWING_M = 0.5  # tolerated distance of a body beyond the middle of a road
BEYOND_M = 12.0  # distance before and after a junction within which a car swings out
MOST_TICKS = 5000


@kernel
def _reaches_over(roads: RoadArrays, row: np.void, lane: int, inwards: int) -> bool:
    """Return whether a corner of a body is more than `SWING_M` beyond the middle of a road."""
    here = roads.lanes[lane]
    if inwards == 0 or (here["left"] if inwards > 0 else here["right"]) >= 0:
        return False
    cos, sin = cos_sin(row["heading"])
    aside = 0.5 * inwards * row["width"]
    most = 0.5 * here["width_m"] + SWING_M
    for end in (-0.5, 0.5):
        ahead = end * row["length"]
        x = row["x"] + ahead * cos - aside * sin
        y = row["y"] + ahead * sin + aside * cos
        s, d, _, _ = project(roads.points, here["first_point"], here["num_points"], x, y)
        if 0.0 < s < here["length_m"] and most < inwards * d < most + here["width_m"]:
            return True
    return False


@kernel
def stays_on_road(
    roads: RoadArrays,
    plan: NDArray[np.void],  # PLAN (1, L) with the next lanes of the path
    grid: LaneGrid,
    row: np.void,  # VEHICLE, blank except for its size; overwritten
    wheelbase: float,  # m
    lane: int,  # LANE where the drive begins
    begin_m: float,  # position on that lane
    last_lane: int,  # LANE where the drive ends
    end_m: float,  # position on that lane
    steering_rad: float,  # largest steering angle
    # side of the middle of the road: 1 left, -1 right, 0: not checked
    inwards: int,
    speed: float,  # m/s
) -> bool:
    """Return whether a slow car stays on its road and on the correct side of it.

    No corner of the body may extend more than `SWING_M` beyond the middle of either road.
    """
    here = roads.lanes[lane]
    x, y, z, cos, sin, _ = lane_pose(roads.points, here["first_point"], here["num_points"], begin_m)
    row["x"], row["y"], row["z"] = x, y, z
    row["heading"] = atan2(sin, cos)
    row["lane"] = lane
    row["s"] = begin_m
    row["d"] = 0.0
    row["speed"] = speed
    for _ in range(MOST_TICKS):
        steering = steer_to_lane(roads, plan, row, row["lane"], wheelbase)
        row["x"], row["y"], row["heading"], _, _ = bicycle_step(
            row["x"],
            row["y"],
            row["heading"],
            speed,
            0.0,
            clamp(steering, -steering_rad, steering_rad),
            wheelbase,
            TRIAL_DT_S,
        )
        if locate(roads, plan, grid, row) != 0:
            return False
        if _reaches_over(roads, row, lane, inwards) or _reaches_over(
            roads, row, last_lane, inwards
        ):
            return False
        if row["lane"] == last_lane and row["s"] >= end_m:
            return True
    return False
