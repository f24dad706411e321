"""A car alone, steered as the built-in driver steers: whether it stays on its road in a bend."""

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

TRIAL_MPS = 3.5  # about the speed to which drivers slow down for sharp bends,
FASTER_MPS = 4.2  # and for those of a right angle
TRIAL_DT_S = 0.1
SWING_M = 0.5  # of a body beyond the middle of a road: others have so much room beside them
BEYOND_M = 12.0  # before and behind a junction: there a car swings out
MOST_TICKS = 5000


@kernel
def _reaches_over(roads: RoadArrays, row: np.void, lane: int, inwards: int) -> bool:
    """Whether a corner of a body lies far beyond the inner side of the innermost lane of a road."""
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
    plan: NDArray[np.void],  # PLAN (1, L) with what follows the lanes ahead
    grid: LaneGrid,
    row: np.void,  # VEHICLE, a blank one with its size; written
    wheelbase: float,  # m, its own one
    lane: int,  # on which it begins,
    begin_m: float,  # and where on it
    last_lane: int,  # on which it ends,
    end_m: float,  # and where on it
    steering_rad: float,  # the most that its front wheels turn
    # 1: the middle of the road is to the left, -1: to the right, 0: where it is does not matter
    inwards: int,
    speed: float,  # m/s
) -> bool:
    """Whether a car that creeps along its way is never off the road or on the wrong side.

    Nor may a corner of its body reach far beyond the middle of either road, where others come.
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
