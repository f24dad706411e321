"""Compute the steering of the lane controller, one quantity after the other."""

from __future__ import annotations

import math

from tests.naive.geometry import wrap_angle
from tests.naive.idm import not_zero


def steering_control(speed: float, d: float, heading_error: float, length: float) -> float:
    """Compute lateral speed, heading, yaw rate, slip and steering in turn from the offset."""
    lateral_speed = -d / 0.6
    sine = max(-1.0, min(1.0, lateral_speed / not_zero(speed)))
    approach = max(-math.pi / 4, min(math.pi / 4, math.asin(sine)))
    yaw_rate = wrap_angle(heading_error + approach) / 0.2
    sine = max(-1.0, min(1.0, length / 2.0 / not_zero(speed) * yaw_rate))
    steering = math.atan(2.0 * math.tan(math.asin(sine)))
    return max(-math.pi / 3, min(math.pi / 3, steering))
