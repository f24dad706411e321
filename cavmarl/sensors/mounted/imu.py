"""IMU: specific force and angular rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cavmarl.config.rig import ImuConfig
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.inertia import measure_inertia
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    noise_of,
)


class Imu(MountedSensor[ImuConfig]):
    """What accelerometers and gyroscopes tell at the sensor's place, along its axes."""

    dtype = np.float32

    def __init__(self, name: str, config: ImuConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._tick_s = platform.sim_dt_s
        self._noise = noise_of(name, config)
        self._room = np.zeros(6)
        self._measure = specialized(measure_inertia)

    @staticmethod
    def bounds(config: ImuConfig) -> Bounds:
        """None: noise has none."""
        return np.full(6, -np.inf), np.full(6, np.inf)

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._measure(
                scene.worlds,
                scene.before,
                self.mount,
                self._tick_s,
                due,
                self._noise,
                self._room,
                frames.data,
            )
