"""The lane-boundary sensor: what a camera that looks for lane markings tells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cavmarl.config.rig import LaneBoundaryConfig
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.lane_offsets import measure_lane_boundary
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    noise_of,
)


class LaneBoundary(MountedSensor[LaneBoundaryConfig]):
    """Boundaries, width, direction and curvature of the lane that the vehicle is on."""

    dtype = np.float32

    def __init__(self, name: str, config: LaneBoundaryConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._noise = noise_of(name, config)
        self._axes = np.zeros((2, 3, 3))
        self._room = np.zeros(5)
        self._measure = specialized(measure_lane_boundary)

    @staticmethod
    def bounds(config: LaneBoundaryConfig) -> Bounds:
        """None: noise has none."""
        return np.full(5, -np.inf), np.full(5, np.inf)

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._measure(
                scene.roads,
                scene.plans,
                scene.worlds,
                self.mount,
                self.config.lookahead_m,
                due,
                self._noise,
                self._axes,
                self._room,
                frames.data,
            )
