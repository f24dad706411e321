"""The Intelligent Driver Model (IDM).

Treiber, Hennecke, Helbing: "Congested traffic states in empirical observations and microscopic
simulations", Phys. Rev. E 62, 2000, with the defaults of highway-env's `IDMVehicle`. As in
highway-env, the desired gap may be negative: a driver is also slowed a little by a leader that
drives away fast.

For several leaders, the acceleration is `idm_free(…) - max(idm_interaction(…), …)`. The powers of 4
and 2 are written as products, because `pow` gives different bits on different processors.
"""

from __future__ import annotations

import math

import numpy as np

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.scalars import clamp, not_zero
from cavmarl.core.records.codes import MODEL_IDM
from cavmarl.driving.kernels.models.car_following_model import (
    LINE_MARGIN_M,
    CarFollowingModel,
    FollowingFunctions,
)

ACCEL_MAX = 3.0  # m/s², desired acceleration from rest on a free road
DECEL_COMFORT = 5.0  # m/s², comfortable deceleration, positive
JAM_DISTANCE_M = 10.0  # between the centres of two stopped cars of 5 m; their bumpers are 5 m apart
TIME_HEADWAY_S = 1.5  # desired time gap
ACCEL_LIMIT = 6.0  # m/s², limit of acceleration and of deceleration

# Distances are measured between the centres of two cars of this length, as in highway-env.
REFERENCE_LENGTH_M = 5.0


@kernel
def idm_free(
    speed: float,  # m/s; a negative speed counts as 0
    target_speed: float,  # m/s, at most the speed limit
    accel_max: float,  # m/s², see `ACCEL_MAX`
) -> float:
    """Return the acceleration on a free road in m/s².

    accel_max · (1 - (speed / target_speed)⁴)
    """
    ratio = max(speed, 0.0) / abs(not_zero(target_speed))
    squared = ratio * ratio
    return accel_max * (1.0 - squared * squared)


@kernel
def idm_interaction(
    speed: float,  # m/s
    distance: float,  # to the leader, m, measured like `jam_distance`; kept 1 cm away from 0
    front_speed: float,  # speed of the leader along the follower's heading, m/s
    accel_max: float,  # m/s², see `ACCEL_MAX`
    decel_comfort: float,  # m/s², positive, see `DECEL_COMFORT`
    jam_distance: float,  # m, see `JAM_DISTANCE_M`
    time_headway: float,  # s, see `TIME_HEADWAY_S`
) -> float:
    """Return by how much a leader reduces the free acceleration, in m/s², at least 0.

    gap         = jam_distance + speed · time_headway
                  + speed · (speed - front_speed) / (2 · sqrt(accel_max · decel_comfort))
    interaction = accel_max · (gap / distance)²
    """
    gap = (
        jam_distance
        + speed * time_headway
        + speed * (speed - front_speed) / (2.0 * math.sqrt(accel_max * decel_comfort))
    )
    ratio = gap / not_zero(distance)
    return accel_max * (ratio * ratio)


@inlined_kernel
def _no_constraint(kind: np.void) -> float:
    return 0.0


@inlined_kernel
def _behind(
    kind: np.void, speed: float, gap: float, front_speed: float, front_decel: float
) -> float:
    return idm_interaction(
        speed,
        max(gap, 0.1) + REFERENCE_LENGTH_M,
        front_speed,
        kind["accel"],
        kind["decel"],
        kind["min_gap"] + REFERENCE_LENGTH_M,
        kind["tau"],
    )


@inlined_kernel
def _before_line(kind: np.void, speed: float, gap: float, dt: float) -> float:
    jam = kind["min_gap"] + REFERENCE_LENGTH_M
    distance = max(gap - LINE_MARGIN_M, 0.1 - kind["min_gap"]) + jam
    return idm_interaction(speed, distance, 0.0, kind["accel"], kind["decel"], jam, kind["tau"])


@inlined_kernel
def _wish(kind: np.void, speed: float, allowed: float, constraint: float) -> float:
    return idm_free(speed, allowed, kind["accel"]) - constraint


@inlined_kernel
def _speed_behind(kind: np.void, gap: float, front_speed: float, front_decel: float) -> float:
    # The positive root of jam + v·tau + v·(v - front) / (2·sqrt(a·b)) = gap.
    scale = 2.0 * math.sqrt(kind["accel"] * kind["decel"])
    linear = kind["tau"] - front_speed / scale
    room = gap - kind["min_gap"]
    if room <= 0.0:
        return 0.0
    root = math.sqrt(linear * linear + 4.0 * room / scale)
    return float(max(0.5 * scale * (root - linear), 0.0))


@inlined_kernel
def _response(
    kind: np.void, speed: float, allowed: float, constraint: float, share: float, dt: float
) -> float:
    accel = idm_free(speed, allowed, kind["accel"]) - constraint
    return clamp(accel, -ACCEL_LIMIT, ACCEL_LIMIT)


IDM = CarFollowingModel(
    "IDM",
    MODEL_IDM,
    FollowingFunctions(_no_constraint, _behind, _before_line, _wish, _speed_behind, _response),
)
