"""What stands ahead, a leader or a line, and what a driver of each model makes of it.

Every obstacle *constrains* the acceleration; of several constraints the largest is the binding one.
They are comparable only between obstacles of one driver: for IDM a constraint is the interaction
that is taken off the free acceleration (m/s²), for Krauss the safe speed with its sign turned
(-m/s), for all others the acceleration that the model asks for with its sign turned (-m/s²).
"""

from __future__ import annotations

import math

import numpy as np

from cavmarl.core.compiled import kernel
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.codes import MODEL_ACC, MODEL_IDM, MODEL_KRAUSS
from cavmarl.driving.kernels.models.acc import acc_acceleration
from cavmarl.driving.kernels.models.idm import ACCEL_LIMIT, idm_free, idm_interaction
from cavmarl.driving.kernels.models.krauss import dawdle, safe_speed
from cavmarl.driving.kernels.models.registered_models import ask_model

# IDM's distances are measured between the centres of two cars of this length, as highway-env does.
REFERENCE_LENGTH_M = 5.0
LINE_MARGIN_M = 1.0  # a driver stops with its front this far before a line


@kernel
def no_constraint(kind: np.void) -> float:
    """The constraint where nothing is ahead."""
    return 0.0 if kind["model"] == MODEL_IDM else -math.inf


@kernel
def _asked(
    kind: np.void, speed: float, allowed: float, gap: float, front_speed: float, front_decel: float
) -> float:
    """The acceleration in m/s² that a model asks for that is neither IDM nor Krauss's."""
    min_gap = float(kind["min_gap"])
    tau = float(kind["tau"])
    accel = float(kind["accel"])
    decel = float(kind["decel"])
    if kind["model"] == MODEL_ACC:
        room = gap - min_gap
        return acc_acceleration(speed, allowed, room, front_speed, front_decel, tau, accel, decel)
    code = int(kind["model"])
    return ask_model(code, speed, allowed, gap, front_speed, min_gap, tau, accel, decel)


@kernel
def _asked_behind(
    kind: np.void, speed: float, gap: float, front_speed: float, front_decel: float
) -> float:
    """The same behind a leader, whatever the limit is."""
    allowed = min(kind["max_speed"], kind["desired_max_speed"])
    return _asked(kind, speed, allowed, gap, front_speed, front_decel)


@kernel
def _asked_of_all(kind: np.void, speed: float, allowed: float, constraint: float) -> float:
    """The same, the free road and all constraints counted."""
    return min(_asked(kind, speed, allowed, math.inf, allowed, kind["decel"]), -constraint)


@kernel
def behind(
    kind: np.void,  # VTYPE of the driver
    speed: float,  # of the driver, m/s
    gap: float,  # between the bumpers, m
    front_speed: float,  # of the leader, m/s
    front_decel: float,  # with which the leader can brake in comfort, m/s²
) -> float:
    """The constraint of a leader."""
    if kind["model"] == MODEL_KRAUSS:
        room = gap - kind["min_gap"]
        return -safe_speed(room, front_speed, kind["decel"], front_decel, kind["tau"])
    if kind["model"] != MODEL_IDM:
        return -_asked_behind(kind, speed, gap, front_speed, front_decel)
    return idm_interaction(
        speed,
        max(gap, 0.1) + REFERENCE_LENGTH_M,
        front_speed,
        kind["accel"],
        kind["decel"],
        kind["min_gap"] + REFERENCE_LENGTH_M,
        kind["tau"],
    )


@kernel
def before_line(kind: np.void, speed: float, gap: float, dt: float) -> float:
    """The constraint of a line that is `gap` m ahead of the front."""
    if kind["model"] == MODEL_KRAUSS:
        return -safe_speed(gap - LINE_MARGIN_M, 0.0, kind["decel"], kind["decel"], dt)
    if kind["model"] != MODEL_IDM:
        wanted = safe_speed(gap - LINE_MARGIN_M, 0.0, kind["decel"], kind["decel"], dt)
        return (speed - wanted) / dt
    jam = kind["min_gap"] + REFERENCE_LENGTH_M
    distance = max(gap - LINE_MARGIN_M, 0.1 - kind["min_gap"]) + jam
    return idm_interaction(speed, distance, 0.0, kind["accel"], kind["decel"], jam, kind["tau"])


@kernel
def wish(kind: np.void, speed: float, allowed: float, constraint: float) -> float:
    """The acceleration in m/s² that a driver would like, as lane changes weigh it.

    Krauss's drivers reach their next speed within a reaction time, whatever the tick is.
    """
    if kind["model"] == MODEL_KRAUSS:
        wanted = min(-constraint, allowed, speed + kind["accel"] * kind["tau"])
        return float((wanted - speed) / kind["tau"])
    if kind["model"] != MODEL_IDM:
        return _asked_of_all(kind, speed, allowed, constraint)
    return idm_free(speed, allowed, kind["accel"]) - constraint


@kernel
def accel_behind(
    kind: np.void, speed: float, allowed: float, gap: float, front_speed: float, front_decel: float
) -> float:
    """`wish` behind one leader."""
    return wish(kind, speed, allowed, behind(kind, speed, gap, front_speed, front_decel))


@kernel
def speed_behind(kind: np.void, gap: float, front_speed: float, front_decel: float) -> float:
    """The speed in m/s at which `gap` m between bumpers is just what a driver wants."""
    if kind["model"] == MODEL_KRAUSS:
        room = gap - kind["min_gap"]
        return safe_speed(room, front_speed, kind["decel"], front_decel, kind["tau"])
    if kind["model"] != MODEL_IDM:
        room = max(gap - kind["min_gap"], 0.0)
        safe = safe_speed(room, front_speed, kind["decel"], front_decel, kind["tau"])
        reached: float = min(room / kind["tau"], safe)
        return reached
    # The positive root of jam + v·tau + v·(v - front) / (2·sqrt(a·b)) = gap.
    scale = 2.0 * math.sqrt(kind["accel"] * kind["decel"])
    linear = kind["tau"] - front_speed / scale
    room = gap - kind["min_gap"]
    if room <= 0.0:
        return 0.0
    root = math.sqrt(linear * linear + 4.0 * room / scale)
    return float(max(0.5 * scale * (root - linear), 0.0))


@kernel
def response(
    kind: np.void,  # VTYPE of the driver
    speed: float,  # m/s
    allowed: float,  # the speed that limits and the vehicle allow, m/s
    constraint: float,  # of all that stands ahead
    share: float,  # a random number in [0, 1), for Krauss's imperfection
    dt: float,  # seconds of the tick
) -> float:
    """The acceleration in m/s² of the coming tick."""
    if kind["model"] == MODEL_KRAUSS:
        wanted = min(-constraint, allowed, speed + kind["accel"] * dt)
        wanted = dawdle(max(wanted, 0.0), kind["accel"], kind["sigma"], share, dt)
        return float(max((wanted - speed) / dt, -kind["emergency_decel"]))
    if kind["model"] != MODEL_IDM:
        asked = _asked_of_all(kind, speed, allowed, constraint)
        return clamp(asked, -kind["emergency_decel"], kind["accel"])
    accel = idm_free(speed, allowed, kind["accel"]) - constraint
    return clamp(accel, -ACCEL_LIMIT, ACCEL_LIMIT)
