"""highway-env's numbers of one vehicle, `Vehicle.to_dict`, and their mapping to [-1, 1].

Its frame is that of its pictures: x to the right, which is east, and y down, which is south;
headings turn clockwise. So on a road to the east, y grows to the right of the driving direction.
All numbers of this file are in that frame: ours with y, headings and lateral offsets negated.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import lane_pose, wrap_angle
from cavmarl.core.numba import kernel

# In the order of config_sensors.VEHICLE_FEATURES, then `on_road`, which is of a place and not of a
# vehicle.
FEATURE_PRESENCE = 0
FEATURE_X = 1
FEATURE_Y = 2
FEATURE_VX = 3
FEATURE_VY = 4
FEATURE_HEADING = 5
FEATURE_COS_H = 6
FEATURE_SIN_H = 7
FEATURE_COS_D = 8
FEATURE_SIN_D = 9
FEATURE_LONG_OFF = 10
FEATURE_LAT_OFF = 11
FEATURE_ANG_OFF = 12
NUM_VEHICLE_FEATURES = 13
FEATURE_ON_ROAD = 13


@kernel
def vehicle_features(
    lanes: NDArray[np.void],
    points: NDArray[np.void],
    row: np.void,
    destinations: NDArray[np.float64],
    intentions: bool,
    out: NDArray[np.float64],
) -> None:
    """All features of a vehicle in the world's frame.

    `destinations`: (G, 2) x and y of each goal in m, our frame. `intentions`: whether the direction
    to the vehicle's goal is shown; else it is 0. `out`: (NUM_VEHICLE_FEATURES,), overwritten.
    """
    cos = math.cos(row["heading"])
    sin = math.sin(row["heading"])
    out[FEATURE_PRESENCE] = 1.0
    out[FEATURE_X] = row["x"]
    out[FEATURE_Y] = -row["y"]
    out[FEATURE_VX] = row["speed"] * cos
    out[FEATURE_VY] = -row["speed"] * sin
    out[FEATURE_HEADING] = -row["heading"]
    out[FEATURE_COS_H] = cos
    out[FEATURE_SIN_H] = -sin
    out[FEATURE_COS_D] = 0.0
    out[FEATURE_SIN_D] = 0.0
    if intentions:
        dx = destinations[row["goal"], 0] - row["x"]
        dy = destinations[row["goal"], 1] - row["y"]
        distance = math.sqrt(dx * dx + dy * dy)
        if distance > 0.0:
            out[FEATURE_COS_D] = dx / distance
            out[FEATURE_SIN_D] = -dy / distance
    lane = lanes[row["lane"]]
    _, _, _, lane_cos, lane_sin, _ = lane_pose(
        points, lane["first_point"], lane["num_points"], row["s"]
    )
    out[FEATURE_LONG_OFF] = row["s"]
    out[FEATURE_LAT_OFF] = -row["d"]
    out[FEATURE_ANG_OFF] = -wrap_angle(row["heading"] - math.atan2(lane_sin, lane_cos))


@kernel
def make_relative(values: NDArray[np.float64], ego: np.void) -> None:
    """Take the place and the velocity of `ego` from those in `values`, in the world's axes."""
    values[FEATURE_X] -= ego["x"]
    values[FEATURE_Y] -= -ego["y"]
    values[FEATURE_VX] -= ego["speed"] * math.cos(ego["heading"])
    values[FEATURE_VY] -= -ego["speed"] * math.sin(ego["heading"])


@kernel
def in_range(value: float, ranges: NDArray[np.float64], feature: int) -> float:
    """The value with the feature's range mapped to [-1, 1]; as it is if it has no range."""
    low = ranges[feature, 0]
    if math.isnan(low):
        return value
    mapped: float = -1.0 + (value - low) * 2.0 / (ranges[feature, 1] - low)
    return mapped
