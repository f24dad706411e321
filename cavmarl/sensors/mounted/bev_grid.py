"""Bird's-eye grid: the classes of the cells around the vehicle, seen from above."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cavmarl.config.rig import BevGridConfig
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.birds_eye import make_birds_eye
from cavmarl.sensors.kernels.panorama import make_panorama
from cavmarl.sensors.kernels.rig_pictures import fill_grids
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.kernels.semantics import NUM_SEMANTICS
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mount_transforms import mount_matrix
from cavmarl.sensors.mounted.mounted_sensor import Bounds, MountedSensor, Platform, SensedScene


class BevGrid(MountedSensor[BevGridConfig]):
    """The class of each cell's centre; see `kernels.semantics`."""

    dtype = np.uint8

    def __init__(self, name: str, config: BevGridConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._view = make_birds_eye(
            mount_matrix(config), config.ahead_m, config.aside_m, config.cell_m
        )
        self._backdrop = platform.backdrop
        self._panorama = make_panorama(platform.backdrop, platform.capacity)
        self._reach_m = self.reach_m(config, 0.0)
        self._fill = specialized(fill_grids)

    @staticmethod
    def bounds(config: BevGridConfig) -> Bounds:
        """The classes."""
        return np.zeros(config.shape), np.full(config.shape, NUM_SEMANTICS - 1.0)

    @staticmethod
    def reach_m(config: BevGridConfig, largest_radius_m: float) -> float:
        """To its farthest corner, and the nearest side of a body."""
        farthest_m = math.hypot(max(config.ahead_m, config.behind_m), config.aside_m)
        return farthest_m + math.hypot(config.x_m, config.y_m) + largest_radius_m

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._fill(
                scene.worlds,
                scene.grid,
                self._backdrop,
                due,
                self._view,
                self._reach_m,
                self._panorama,
                frames.data,
            )
