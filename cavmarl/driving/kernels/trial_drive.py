"""A car alone, steered as the built-in driver steers: whether it stays on its road in a bend."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import lane_pose
from cavmarl.core.math.scalars import clamp
from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import LaneGrid, RoadArrays
from cavmarl.driving.kernels.bicycle import bicycle_step
from cavmarl.driving.kernels.steering import steer_to_lane
from cavmarl.driving.kernels.tracking import locate

TRIAL_MPS = 2.7  # the speed to which drivers slow down for the sharpest bends
TRIAL_DT_S = 0.1
BEYOND_M = 12.0  # before and behind a junction: there a car swings out
MOST_TICKS = 5000


@kernel
def stays_on_road(
    roads: RoadArrays,
    plan: NDArray[np.void],  # PLAN (1, L) with what follows the lanes ahead
    grid: LaneGrid,
    row: np.void,  # VEHICLE, a blank one with its size; written
    lane: int,  # on which it begins,
    begin_m: float,  # and where on it
    last_lane: int,  # on which it ends,
    end_m: float,  # and where on it
    steering_rad: float,  # the most that its front wheels turn
) -> bool:
    """Whether a car that creeps along its way is never off the road or on the wrong side."""
    here = roads.lanes[lane]
    x, y, z, cos, sin, _ = lane_pose(roads.points, here["first_point"], here["num_points"], begin_m)
    row["x"], row["y"], row["z"] = x, y, z
    row["heading"] = math.atan2(sin, cos)
    row["lane"] = lane
    row["s"] = begin_m
    row["d"] = 0.0
    row["speed"] = TRIAL_MPS
    for _ in range(MOST_TICKS):
        steering = steer_to_lane(roads, plan, row, row["lane"])
        row["x"], row["y"], row["heading"], _, _ = bicycle_step(
            row["x"],
            row["y"],
            row["heading"],
            TRIAL_MPS,
            0.0,
            clamp(steering, -steering_rad, steering_rad),
            row["length"],
            TRIAL_DT_S,
        )
        if locate(roads, plan, grid, row) != 0:
            return False
        if row["lane"] == last_lane and row["s"] >= end_m:
            return True
    return False
