"""Radar: the nearest targets with range, azimuth and radial speed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cavmarl.config.rig import RadarConfig
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.panorama import make_panorama
from cavmarl.sensors.kernels.radar_targets import TARGET
from cavmarl.sensors.kernels.ray_fan import HIT, make_fan
from cavmarl.sensors.kernels.rig_rays import measure_radar
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.lidar import azimuths
from cavmarl.sensors.mounted.mount_transforms import mount_matrix
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    noise_of,
)


class Radar(MountedSensor[RadarConfig]):
    """Bodies and buildings, nearest first; the rest of the list is zeros."""

    dtype = np.float32

    def __init__(self, name: str, config: RadarConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._noise = noise_of(name, config)
        fan = azimuths(config.fov_deg, config.rays)
        self._fan = make_fan(mount_matrix(config), fan, np.zeros(1), config.range_m)
        self._backdrop = platform.backdrop
        self._panorama = make_panorama(platform.backdrop, platform.capacity)
        self._hits = np.zeros((config.rays, 1), HIT)
        self._targets = np.zeros(config.rays, TARGET)
        self._order = np.zeros(config.rays, np.int32)
        self._measure = specialized(measure_radar)

    @staticmethod
    def bounds(config: RadarConfig) -> Bounds:
        """None: noise has none."""
        return np.full(config.shape, -np.inf), np.full(config.shape, np.inf)

    @staticmethod
    def reach_m(config: RadarConfig, largest_radius_m: float) -> float:
        """Its range, from where it is mounted to the nearest side of a body."""
        return config.range_m + math.hypot(config.x_m, config.y_m) + largest_radius_m

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._measure(
                scene.worlds,
                scene.grid,
                self._backdrop,
                due,
                self._noise,
                self._fan,
                self._panorama,
                self._hits,
                self._targets,
                self._order,
                frames.data,
            )
