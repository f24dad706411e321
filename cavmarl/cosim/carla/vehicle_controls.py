"""Conversion of CARLA's controls to the actions of an agent."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.action import ActionConfig

FULL_STEER_RAD = math.radians(70.0)  # angle of the front wheels at steer = 1
WHEELBASE_SHARE = 0.6  # wheelbase / length of CARLA's vehicles; agents' axles can be farther apart
THROTTLE_MPS2 = 4.5  # acceleration at throttle = 1
BRAKE_MPS2 = 8.0  # deceleration at brake = 1
_ROLLING_MPS2 = 0.2  # deceleration without throttle, and its increase per m/s
_DRAG_PER_S = 0.02
_LARGEST_SINE = 0.99  # largest sine of the slip angle
_STANDING_MPS = 0.01
_ACKERMANN_PER_S = 2.0  # acceleration per m/s of difference to the target speed


class CarlaControl(NamedTuple):
    """CARLA's `VehicleControl`."""

    throttle: float = 0.0
    steer: float = 0.0  # positive to the right
    brake: float = 0.0
    hand_brake: bool = False
    reverse: bool = False
    manual_gear_shift: bool = False
    gear: int = 0

    @property
    def is_backward(self) -> bool:
        return self.reverse or (self.manual_gear_shift and self.gear < 0)


class AckermannControl(NamedTuple):
    """CARLA's `VehicleAckermannControl`."""

    steer: float  # rad, positive to the right
    steer_speed: float  # rad/s; 0: as fast as possible
    speed: float  # m/s
    acceleration: float  # m/s²; 0: as needed
    jerk: float


Control = CarlaControl | AckermannControl


def drives_backward(control: Control, speed_mps: float) -> bool:
    """Return whether a control moves a vehicle backwards, or slows it while it rolls backwards."""
    if abs(speed_mps) > _STANDING_MPS:
        return speed_mps < 0.0
    if isinstance(control, AckermannControl):
        return control.speed < 0.0
    is_braked = control.hand_brake or BRAKE_MPS2 * control.brake >= THROTTLE_MPS2 * control.throttle
    return control.is_backward and not is_braked


def backward_motion_of(control: Control, speed_mps: float) -> tuple[float, float]:
    """Return acceleration and wheel angle, as `motion_of`, of a vehicle with a speed of 0 or less.

    In the reverse gear, throttle accelerates backwards; in other gears, it slows the vehicle.
    """
    if isinstance(control, AckermannControl):
        acceleration, angle = motion_of(
            control._replace(speed=-control.speed, steer=-control.steer), -speed_mps
        )
        return -acceleration, -angle
    forward = control._replace(reverse=False, manual_gear_shift=False, steer=-control.steer)
    if not control.is_backward:
        forward = forward._replace(throttle=0.0, brake=max(control.brake, control.throttle))
    acceleration, angle = motion_of(forward, -speed_mps)
    return -acceleration, -angle


def motion_of(control: Control, speed_mps: float) -> tuple[float, float]:
    """Return the acceleration in m/s² and the angle of the front wheels in rad, left positive.

    The speed is 0 or more. In the reverse gear, throttle slows the vehicle.
    """
    if isinstance(control, AckermannControl):
        wanted = _ACKERMANN_PER_S * (control.speed - speed_mps)
        most = abs(control.acceleration) or THROTTLE_MPS2
        return min(max(wanted, -BRAKE_MPS2), most), -control.steer
    throttle = min(max(control.throttle, 0.0), 1.0)
    if control.is_backward:
        throttle = -throttle if speed_mps > 0.0 else 0.0
    brake = 1.0 if control.hand_brake else min(max(control.brake, 0.0), 1.0)
    resistance = _ROLLING_MPS2 + _DRAG_PER_S * speed_mps if speed_mps > 0.0 else 0.0
    acceleration = THROTTLE_MPS2 * throttle - BRAKE_MPS2 * brake - resistance
    return acceleration, -FULL_STEER_RAD * min(max(control.steer, -1.0), 1.0)


def action_of(
    control: Control, speed_mps: float, axles_apart: float, config: ActionConfig
) -> NDArray[np.float32]:
    """Return the continuous action of an agent that moves as a control demands.

    `axles_apart`: wheelbase of the agent's vehicle as a share of its length.
    """
    acceleration, angle = motion_of(control, speed_mps)
    angle = same_turn(angle, axles_apart / WHEELBASE_SHARE)
    pair = [acceleration / config.acceleration_mps2, angle / config.steering_rad]
    return np.clip(pair, -1.0, 1.0).astype(np.float32)


def same_turn(angle_rad: float, times_wheelbase: float) -> float:
    """Return the wheel angle that turns a longer vehicle as fast as `angle_rad` turns this vehicle.

    The vehicles are kinematic bicycles, see `driving.kernels.motion.bicycle`. The result is below a
    right angle, so a longer vehicle cannot make every turn.
    """
    slip = math.atan(0.5 * math.tan(angle_rad))
    sine = min(max(times_wheelbase * math.sin(slip), -_LARGEST_SINE), _LARGEST_SINE)
    return math.atan(2.0 * math.tan(math.asin(sine)))
