"""Models that compute an acceleration for each leader; drivers apply the lowest acceleration.

Such a model needs only one function of its own. Before lines, drivers brake as in Krauss's model.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from cavmarl.core.compiled import inlined_function, inlined_kernel
from cavmarl.core.math.scalars import clamp
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M, FollowingFunctions
from cavmarl.driving.kernels.models.krauss import safe_speed

# Returns the acceleration in m/s² of a driver for (VTYPE, speed, allowed speed, gap between the
# bumpers, leader's speed, leader's comfortable deceleration). On a free road the gap is infinite.
Acceleration: TypeAlias = Callable[[np.void, float, float, float, float, float], float]


@inlined_kernel
def _no_constraint(kind: np.void) -> float:
    return -math.inf


@inlined_kernel
def _before_line(kind: np.void, speed: float, gap: float, dt: float) -> float:
    wanted = safe_speed(gap - LINE_MARGIN_M, 0.0, kind["decel"], kind["decel"], dt)
    return (speed - wanted) / dt


@inlined_kernel
def _speed_behind(kind: np.void, gap: float, front_speed: float, front_decel: float) -> float:
    room = max(gap - kind["min_gap"], 0.0)
    safe = safe_speed(room, front_speed, kind["decel"], front_decel, kind["tau"])
    reached: float = min(room / kind["tau"], safe)
    return reached


def acceleration_model(acceleration: Acceleration) -> FollowingFunctions:
    """Return the functions of a model, made from a compiled function of the acceleration."""

    @inlined_function
    def behind(
        kind: np.void, speed: float, gap: float, front_speed: float, front_decel: float
    ) -> float:
        allowed = min(kind["max_speed"], kind["desired_max_speed"])
        return -acceleration(kind, speed, allowed, gap, front_speed, front_decel)

    @inlined_function
    def wish(kind: np.void, speed: float, allowed: float, constraint: float) -> float:
        free = acceleration(kind, speed, allowed, math.inf, allowed, kind["decel"])
        return min(free, -constraint)

    @inlined_function
    def response(
        kind: np.void, speed: float, allowed: float, constraint: float, share: float, dt: float
    ) -> float:
        wanted = wish(kind, speed, allowed, constraint)
        return clamp(wanted, -kind["emergency_decel"], kind["accel"])

    return FollowingFunctions(_no_constraint, behind, _before_line, wish, _speed_behind, response)
