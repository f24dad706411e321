"""What stands ahead as the car-following model takes it: a leader, or a line to stop at."""

from __future__ import annotations

import numpy as np

from cavmarl.kernels import kernel
from cavmarl.kernels.car_following import (
    ACCEL_MAX,
    DECEL_COMFORT,
    JAM_DISTANCE_M,
    TIME_HEADWAY_S,
    idm_free,
    idm_interaction,
)

__all__ = ["LINE_MARGIN_M", "REFERENCE_LENGTH_M", "accel_behind", "before_line", "behind"]

REFERENCE_LENGTH_M = 5.0  # JAM_DISTANCE_M is measured between centres of cars of this length
LINE_MARGIN_M = 1.0  # a driver stops with its front this far before a line


@kernel
def behind(row: np.void, distance: float, other: np.void) -> float:
    """IDM's interaction with a leader whose centre is `distance` m ahead."""
    net = distance - 0.5 * (row["length"] + other["length"])
    return idm_interaction(
        row["speed"],
        max(net, 0.1) + REFERENCE_LENGTH_M,
        other["speed"],
        ACCEL_MAX,
        DECEL_COMFORT,
        JAM_DISTANCE_M,
        TIME_HEADWAY_S,
    )


@kernel
def before_line(row: np.void, distance: float) -> float:
    """IDM's interaction with a line `distance` m ahead of the vehicle's front."""
    return idm_interaction(
        row["speed"],
        max(distance - LINE_MARGIN_M, 0.1 - JAM_DISTANCE_M + REFERENCE_LENGTH_M) + JAM_DISTANCE_M,
        0.0,
        ACCEL_MAX,
        DECEL_COMFORT,
        JAM_DISTANCE_M,
        TIME_HEADWAY_S,
    )


@kernel
def accel_behind(row: np.void, target_speed: float, distance: float, leader: np.void) -> float:
    """Acceleration in m/s² behind a leader whose centre is `distance` m ahead."""
    return idm_free(row["speed"], target_speed, ACCEL_MAX) - behind(row, distance, leader)
