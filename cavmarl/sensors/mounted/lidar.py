"""Lidar: distances along rays, of one layer or of several."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cavmarl.config.rig import LidarRigConfig
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.panorama import make_panorama
from cavmarl.sensors.kernels.ray_fan import HIT, Fan, make_fan
from cavmarl.sensors.kernels.rig_rays import measure_lidar
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mount_transforms import mount_matrix
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    noise_of,
)


def azimuths(fov_deg: float, rays: int) -> tuple[float, float, int]:
    """The first ray, from one to the next, and how many: in rad, counter-clockwise.

    All around they begin forward; less than that, from the right edge to the left one.
    """
    if fov_deg == 360.0 or rays == 1:
        return 0.0, 2.0 * math.pi / rays, rays
    fov = math.radians(fov_deg)
    return -0.5 * fov, fov / (rays - 1), rays


def lidar_fan(config: LidarRigConfig) -> Fan:
    """The rays of a lidar."""
    lowest, highest = math.radians(config.lower_deg), math.radians(config.upper_deg)
    layers = np.linspace(lowest, highest, config.layers) if config.layers > 1 else np.zeros(1)
    return make_fan(
        mount_matrix(config), azimuths(config.fov_deg, config.rays), layers, config.range_m
    )


class Lidar(MountedSensor[LidarRigConfig]):
    """Distances to bodies, buildings and the ground, layer by layer from the lowest."""

    dtype = np.float32

    def __init__(self, name: str, config: LidarRigConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._noise = noise_of(name, config)
        self._fan = lidar_fan(config)
        self._backdrop = platform.backdrop
        self._panorama = make_panorama(platform.backdrop, platform.capacity)
        self._hits = np.zeros((config.rays, config.layers), HIT)
        self._measure = specialized(measure_lidar)

    @staticmethod
    def bounds(config: LidarRigConfig) -> Bounds:
        """From 0 to the range."""
        return np.zeros(config.shape), np.full(config.shape, config.range_m)

    @staticmethod
    def reach_m(config: LidarRigConfig, largest_radius_m: float) -> float:
        """Its range, from where it is mounted to the nearest side of a body."""
        return config.range_m + math.hypot(config.x_m, config.y_m) + largest_radius_m

    @staticmethod
    def num_lines(config: LidarRigConfig) -> int:
        """The columns of rays."""
        return config.rays

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._measure(
                scene.worlds,
                scene.grid,
                self._backdrop,
                due,
                self.lines,
                self._noise,
                self._fan,
                self._panorama,
                self._hits,
                frames.data,
            )
