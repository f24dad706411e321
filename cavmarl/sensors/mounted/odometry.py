"""Odometry: what the wheels tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cavmarl.config.rig import OdometryConfig
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.kernels.wheel_motion import measure_odometry
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    noise_of,
)


class Odometry(MountedSensor[OdometryConfig]):
    """Speed, yaw rate and driven distance of the vehicle's centre."""

    dtype = np.float32

    def __init__(self, name: str, config: OdometryConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._noise = noise_of(name, config)
        self._room = np.zeros(3)
        self._measure = specialized(measure_odometry)

    @staticmethod
    def bounds(config: OdometryConfig) -> Bounds:
        """None: noise has none."""
        return np.full(3, -np.inf), np.full(3, np.inf)

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._measure(scene.worlds, scene.before, due, self._noise, self._room, frames.data)
