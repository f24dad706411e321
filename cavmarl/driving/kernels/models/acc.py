"""Adaptive cruise control: the acceleration that a measured controller asks for.

Milanés, Shladover: "Modeling cooperative and autonomous adaptive cruise control dynamic responses
using experimental data", Transportation Research C 48, 2014; Xiao, Wang, van Arem: "Realistic
car-following models for microscopic simulation of adaptive and cooperative adaptive cruise control
vehicles", Transportation Research Record 2623, 2017, whose four modes these are. A vehicle keeps no
mode from tick to tick: what stands ahead decides. As SUMO does, it never exceeds the safe speed of
Krauss's model by more than `EMERGENCY_MPS`.
"""

from __future__ import annotations

import math

from cavmarl.core.compiled import kernel
from cavmarl.core.math.scalars import clamp
from cavmarl.driving.kernels.models.krauss import safe_speed

SPEED_MODE_S = 2.0  # time gap in s above which a leader does not count
SPEED_GAIN = 0.4  # 1/s
CONTROL_SPACE, CONTROL_SPEED = 0.23, 0.07  # 1/s², 1/s: near the wanted gap,
CONTROL_M, CONTROL_MPS = 0.2, 0.1  # nearer than so
CLOSING_SPACE, CLOSING_SPEED = 0.04, 0.8  # the gap is larger
AVOIDING_SPACE, AVOIDING_SPEED = 0.8, 0.23  # it is smaller
EMERGENCY_MPS = 2.0
SLOW_MPS, FAST_MPS = 10.8, 15.0  # the slower, the more room beyond the time gap:
SLOW_ROOM_M = 2.0  # below the first; above the second none


@kernel
def _extra_room_m(speed: float) -> float:
    """The room in m that is kept beyond the time gap."""
    if speed >= FAST_MPS:
        return 0.0
    return 75.0 / speed - 5.0 if speed >= SLOW_MPS else SLOW_ROOM_M


@kernel
def acc_acceleration(
    speed: float,  # m/s
    allowed: float,  # the speed to keep on a free road, m/s
    room: float,  # to the leader, less the gap at rest, m; inf: there is none
    front_speed: float,  # of the leader, m/s
    front_decel: float,  # with which the leader can brake in comfort, m/s²
    tau: float,  # time gap to keep, s
    accel: float,  # the most that it accelerates, m/s²
    decel: float,  # the most that it brakes to keep a speed, m/s², positive
) -> float:
    """Acceleration in m/s², at most `accel`."""
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
