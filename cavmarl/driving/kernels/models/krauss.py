"""Krauss's model: the largest speed at which a driver can still stop behind its leader.

Krauss: "Microscopic modeling of traffic flow: investigation of collision free vehicle dynamics",
DLR-Forschungsbericht 98-08, 1998, eq. 2.13, in the form that is SUMO's default: the leader's
braking distance is computed with the larger of the two decelerations.
"""

from __future__ import annotations

import math

import numpy as np

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.codes import MODEL_KRAUSS
from cavmarl.driving.kernels.models.car_following_model import (
    LINE_MARGIN_M,
    CarFollowingModel,
    FollowingFunctions,
)


@kernel
def safe_speed(
    gap: float,  # distance that may be used up, m; a negative gap gives 0 m/s
    front_speed: float,  # speed of the leader, m/s; 0 for a line
    decel: float,  # deceleration of the driver, m/s², positive
    front_decel: float,  # deceleration of the leader, m/s², positive
    reaction_s: float,  # time before the driver brakes, s
) -> float:
    """Return the largest speed in m/s at which braking after `reaction_s` does not use up the gap.

    Solves v · reaction_s + v² / (2 · decel) = gap + front_speed² / (2 · max(decel, front_decel)).
    """
    room = gap + 0.5 * front_speed * front_speed / max(decel, front_decel)
    if room <= 0.0:
        return 0.0
    lag = decel * reaction_s
    return math.sqrt(lag * lag + 2.0 * decel * room) - lag


@kernel
def dawdle(
    speed: float,  # without imperfection, m/s
    accel: float,  # the largest acceleration, m/s²
    sigma: float,  # imperfection in [0, 1]
    share: float,  # a random number in [0, 1)
    dt: float,  # length of the tick, s
) -> float:
    """Return the speed in m/s reduced by a random amount, for imperfect driving."""
    # At low speed the loss is proportional to the speed, so that a stopped vehicle can start.
    return max(speed - dt * sigma * min(accel, speed) * share, 0.0)


@inlined_kernel
def _no_constraint(kind: np.void) -> float:
    return -math.inf


@inlined_kernel
def _behind(
    kind: np.void, speed: float, gap: float, front_speed: float, front_decel: float
) -> float:
    return -_speed_behind(kind, gap, front_speed, front_decel)


@inlined_kernel
def _before_line(kind: np.void, speed: float, gap: float, dt: float) -> float:
    return -safe_speed(gap - LINE_MARGIN_M, 0.0, kind["decel"], kind["decel"], dt)


@inlined_kernel
def _wish(kind: np.void, speed: float, allowed: float, constraint: float) -> float:
    # The next speed is reached within one reaction time, whatever the length of a tick.
    wanted = min(-constraint, allowed, speed + kind["accel"] * kind["tau"])
    return float((wanted - speed) / kind["tau"])


@inlined_kernel
def _speed_behind(kind: np.void, gap: float, front_speed: float, front_decel: float) -> float:
    room = gap - kind["min_gap"]
    return safe_speed(room, front_speed, kind["decel"], front_decel, kind["tau"])


@inlined_kernel
def _response(
    kind: np.void, speed: float, allowed: float, constraint: float, share: float, dt: float
) -> float:
    wanted = min(-constraint, allowed, speed + kind["accel"] * dt)
    wanted = dawdle(max(wanted, 0.0), kind["accel"], kind["sigma"], share, dt)
    return float(max((wanted - speed) / dt, -kind["emergency_decel"]))


KRAUSS = CarFollowingModel(
    "Krauss",
    MODEL_KRAUSS,
    FollowingFunctions(_no_constraint, _behind, _before_line, _wish, _speed_behind, _response),
    as_sumo=True,
    uses_sigma=True,
)
