"""Adaptive cruise control (ACC): the acceleration of a controller fitted to measurements.

Milanés, Shladover: "Modeling cooperative and autonomous adaptive cruise control dynamic responses
using experimental data", Transportation Research C 48, 2014; Xiao, Wang, van Arem: "Realistic
car-following models for microscopic simulation of adaptive and cooperative adaptive cruise control
vehicles", Transportation Research Record 2623, 2017, which describes the four modes. The mode is
chosen anew in every tick, from the gap and the speeds. As in SUMO, the speed exceeds the safe speed
of Krauss's model by at most `EMERGENCY_MPS`.
"""

from __future__ import annotations

import math

import numpy as np

from cavmarl.core.compiled import kernel
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.codes import MODEL_ACC
from cavmarl.driving.kernels.models.acceleration_models import acceleration_model
from cavmarl.driving.kernels.models.car_following_model import CarFollowingModel
from cavmarl.driving.kernels.models.krauss import safe_speed

# Gains for the distance error in 1/s² (`…_SPACE`) and for the speed difference in 1/s (`…_SPEED`).
SPEED_MODE_S = 2.0  # speed mode: if the time gap is larger than this, the leader is ignored
SPEED_GAIN = 0.4  # 1/s
CONTROL_SPACE, CONTROL_SPEED = 0.23, 0.07  # gap control mode
CONTROL_M, CONTROL_MPS = 0.2, 0.1  # largest distance error and speed difference in that mode
CLOSING_SPACE, CLOSING_SPEED = 0.04, 0.8  # gap closing mode
AVOIDING_SPACE, AVOIDING_SPEED = 0.8, 0.23  # collision avoidance mode: the gap is too small
EMERGENCY_MPS = 2.0
# Room in addition to the time gap: `SLOW_ROOM_M` below the first speed, none above the second.
SLOW_MPS, FAST_MPS = 10.8, 15.0
SLOW_ROOM_M = 2.0


@kernel
def _extra_room_m(speed: float) -> float:
    """Return the room in m that is kept in addition to the time gap."""
    if speed >= FAST_MPS:
        return 0.0
    return 75.0 / speed - 5.0 if speed >= SLOW_MPS else SLOW_ROOM_M


@kernel
def acc_acceleration(
    speed: float,  # m/s
    allowed: float,  # desired speed on a free road, m/s
    room: float,  # gap to the leader minus the gap at rest, m; infinite without a leader
    front_speed: float,  # speed of the leader, m/s
    front_decel: float,  # the leader's comfortable deceleration, m/s², positive
    tau: float,  # desired time gap, s
    accel: float,  # largest acceleration, m/s²
    decel: float,  # largest deceleration in speed mode, m/s², positive
) -> float:
    """Return the acceleration in m/s², at most `accel`."""
    asked = clamp(SPEED_GAIN * (allowed - speed), -decel, accel)
    if room == math.inf:
        return asked
    if room <= SPEED_MODE_S * speed:
        error = room - tau * speed - _extra_room_m(speed)
        faster = front_speed - speed
        if error < 0.0:
            asked = min(asked, AVOIDING_SPACE * error + AVOIDING_SPEED * faster)
        elif error < CONTROL_M and abs(faster) < CONTROL_MPS:
            asked = min(asked, CONTROL_SPACE * error + CONTROL_SPEED * faster)
        else:
            asked = min(asked, CLOSING_SPACE * error + CLOSING_SPEED * faster)
    safe = safe_speed(room, front_speed, decel, front_decel, tau) + EMERGENCY_MPS
    return min(asked, (safe - speed) / tau)


@kernel
def _acceleration(
    kind: np.void, speed: float, allowed: float, gap: float, front_speed: float, front_decel: float
) -> float:
    min_gap = float(kind["min_gap"])
    tau = float(kind["tau"])
    accel = float(kind["accel"])
    decel = float(kind["decel"])
    room = gap - min_gap
    return acc_acceleration(speed, allowed, room, front_speed, front_decel, tau, accel, decel)


ACC = CarFollowingModel("ACC", MODEL_ACC, acceleration_model(_acceleration))
