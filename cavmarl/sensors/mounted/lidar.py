"""Sensors that cast rays: single-layer and multi-layer lidar, and radar."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.rig import LidarRigConfig, RadarConfig
from cavmarl.core.math.elementary import hypot
from cavmarl.sensors.kernels.ray_caster import HIT, Fan, make_fan, ray_directions
from cavmarl.sensors.kernels.rig_frames import Due
from cavmarl.sensors.kernels.rig_rays import TARGET, measure_lidar, measure_radar
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mount_transforms import mount_matrix
from cavmarl.sensors.mounted.mounted_sensor import Bounds, ImagingSensor, Platform, SensedScene

C = TypeVar("C", LidarRigConfig, RadarConfig)
Floats = NDArray[np.float64]

ECHO_MARGIN_M = 0.05  # a ray whose distance is within this margin of the range has no echo


def azimuths(fov_deg: float, rays: int) -> tuple[float, float, int]:
    """Return the azimuth of the first ray, the step (both in rad), and the number of rays.

    Azimuths are counter-clockwise. A full circle begins straight ahead; a smaller field of view
    goes from its right edge to its left edge.
    """
    if fov_deg == 360.0 or rays == 1:
        return 0.0, 2.0 * math.pi / rays, rays
    fov = math.radians(fov_deg)
    return -0.5 * fov, fov / (rays - 1), rays


def elevations(lower_deg: float, upper_deg: float, layers: int) -> Floats:
    """Return the elevation of each layer of a lidar in rad, lowest first; 0 for a single layer."""
    if layers == 1:
        return np.zeros(1)
    return np.linspace(math.radians(lower_deg), math.radians(upper_deg), layers)


def lidar_directions(
    fov_deg: float, rays: int, lower_deg: float, upper_deg: float, layers: int
) -> Floats:
    """Return the unit vector (layers, rays, 3) of each ray of a lidar, in the sensor's frame."""
    rising = elevations(lower_deg, upper_deg, layers)
    return ray_directions(azimuths(fov_deg, rays), rising).swapaxes(0, 1)


def has_echo(distances_m: Floats, range_m: float) -> NDArray[np.bool_]:
    """Return for each distance whether its ray has a hit; without a hit, it is `range_m`."""
    return distances_m < range_m - ECHO_MARGIN_M


def lidar_fan(config: LidarRigConfig) -> Fan:
    """Return the rays of a lidar for the ray caster."""
    return make_fan(
        mount_matrix(config),
        azimuths(config.fov_deg, config.rays),
        elevations(config.lower_deg, config.upper_deg, config.layers),
        config.range_m,
    )


class _Rays(ImagingSensor[C]):
    """Base class of lidar and radar."""

    @staticmethod
    def reach_m(config: C, largest_radius_m: float) -> float:
        """Return the range, measured from the mount, plus the largest radius of a body."""
        return config.range_m + hypot(config.x_m, config.y_m) + largest_radius_m


class Lidar(_Rays[LidarRigConfig]):
    """A lidar: distances to bodies, buildings and the ground, by layer from the lowest."""

    dtype = np.float32
    kernel = measure_lidar

    def __init__(self, name: str, config: LidarRigConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._fan = lidar_fan(config)
        self._hits = np.zeros((config.rays, config.layers), HIT)

    @staticmethod
    def bounds(config: LidarRigConfig) -> Bounds:
        return np.zeros(config.shape), np.full(config.shape, config.range_m)

    @staticmethod
    def num_lines(config: LidarRigConfig) -> int:
        return config.rays

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        cast = (self._fan, self._panorama, self._hits)
        return (*self.view(scene, due), self.lines, self.noise, *cast, frames.data)


class Radar(_Rays[RadarConfig]):
    """A radar: range, azimuth and radial speed of the nearest bodies and buildings, nearest first.

    Unused rows of the list are zeros.
    """

    dtype = np.float32
    kernel = measure_radar

    def __init__(self, name: str, config: RadarConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        fan = azimuths(config.fov_deg, config.rays)
        self._fan = make_fan(mount_matrix(config), fan, np.zeros(1), config.range_m)
        self._hits = np.zeros((config.rays, 1), HIT)
        self._targets = np.zeros(config.rays, TARGET)
        self._order = np.zeros(config.rays, np.int32)

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        cast = (self._fan, self._panorama, self._hits, self._targets, self._order)
        return (*self.view(scene, due), self.noise, *cast, frames.data)
