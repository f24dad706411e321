"""Where a sensor is mounted and which way it looks, as a matrix."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.config_rig import MountedConfig

__all__ = ["mount_matrix"]


def mount_matrix(config: MountedConfig) -> NDArray[np.float64]:
    """(3, 4): the sensor's axes (ahead, left, up) as columns and its place, in the vehicle's frame.

    Turned about z by the yaw, then nose up by the pitch, then left side up by the roll. Multiples
    of a right angle are exact.
    """
    yaw_cos, yaw_sin = _turn(config.yaw_deg)
    pitch_cos, pitch_sin = _turn(config.pitch_deg)
    roll_cos, roll_sin = _turn(config.roll_deg)
    ahead = (yaw_cos * pitch_cos, yaw_sin * pitch_cos, pitch_sin)
    level = (-yaw_sin, yaw_cos, 0.0)
    upright = (-yaw_cos * pitch_sin, -yaw_sin * pitch_sin, pitch_cos)
    left = [roll_cos * a + roll_sin * b for a, b in zip(level, upright, strict=True)]
    up = [roll_cos * b - roll_sin * a for a, b in zip(level, upright, strict=True)]
    return np.array([ahead, left, up, (config.x_m, config.y_m, config.z_m)]).T.copy()


def _turn(angle_deg: float) -> tuple[float, float]:
    """Cosine and sine of an angle in degrees."""
    quarters = angle_deg / 90.0
    if quarters == round(quarters):
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    return math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
