"""Rays around the vehicle that end at other vehicles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import SensorsConfig
from cavmarl.sensors.kernels.lidar_fan import ECHO, ray_directions
from cavmarl.sensors.observed.feature import Feature


def features(config: SensorsConfig) -> list[Feature]:
    """Distances of all rays, then, with `speeds`, the relative speeds of what they met."""
    lidar = config.lidar
    rays = range(lidar.rays)
    step = 360.0 / max(lidar.rays, 1)
    found = [
        Feature(
            f"distance_{k}",
            f"distance along the ray {k * step:g}° left of straight ahead; 1 where nothing is",
            f"{lidar.range_m:g} m",
        )
        for k in rays
    ]
    if lidar.speeds:
        found += [
            Feature(
                f"speed_{k}",
                "velocity of what the ray met minus the own one, along the ray; 0 where nothing is",
                "40 m/s",
            )
            for k in rays
        ]
    return found


def reach_m(config: SensorsConfig) -> float:
    return config.lidar.range_m if config.lidar.rays else 0.0


def directions(config: SensorsConfig) -> NDArray[np.float64]:
    """Cosines and sines (rays, 2) of the rays in the ego frame."""
    return ray_directions(config.lidar.rays)


def room(config: SensorsConfig) -> NDArray[np.void]:
    """ECHO (rays,): the array that a scan is written to."""
    return np.zeros(config.lidar.rays, dtype=ECHO)
