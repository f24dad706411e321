"""Controllers of lane and speed, as in highway-env's `ControlledVehicle`.

The lateral controller is a cascade: lateral offset → lateral speed → heading → yaw rate → steering
angle; each step is a proportional controller.
"""

from __future__ import annotations

import math

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import asin, atan2
from cavmarl.core.math.geometry import wrap_angle
from cavmarl.core.math.scalars import clamp, not_zero

KP_ACCEL = 1.0 / 0.6  # 1/s, gain from speed error to acceleration
KP_HEADING = 1.0 / 0.2  # 1/s, gain from heading error to yaw rate
KP_LATERAL = 1.0 / 0.6  # 1/s, gain from lateral offset to lateral speed
PURSUIT_S = 0.1  # the lane's direction is read at s + speed · PURSUIT_S
MAX_STEERING_RAD = math.pi / 3.0
MAX_APPROACH_RAD = math.pi / 4.0  # steepest angle at which a lane is approached


@kernel
def steering_control(
    speed: float,  # m/s
    d: float,  # lateral offset from the lane's centre in m, positive to the left
    heading_error: float,  # lane's direction `speed · PURSUIT_S` ahead minus the car's heading, rad
    length: float,  # length of the car, m
) -> float:  # angle within ±`MAX_STEERING_RAD`, positive to the left
    """Return the steering angle in rad that moves a car to the centre of a lane."""
    divisor = not_zero(speed)
    approach = asin(clamp(-KP_LATERAL * d / divisor, -1.0, 1.0))
    approach = clamp(approach, -MAX_APPROACH_RAD, MAX_APPROACH_RAD)
    yaw_rate = KP_HEADING * wrap_angle(heading_error + approach)
    sin_slip = clamp(0.5 * length / divisor * yaw_rate, -1.0, 1.0)
    # tan(steering) = 2 · tan(slip); this form has no pole.
    steering = atan2(2.0 * sin_slip, math.sqrt(1.0 - sin_slip * sin_slip))
    return clamp(steering, -MAX_STEERING_RAD, MAX_STEERING_RAD)


@kernel
def speed_control(speed: float, target_speed: float) -> float:
    """Return the unlimited acceleration in m/s² towards a target speed in m/s."""
    return KP_ACCEL * (target_speed - speed)
