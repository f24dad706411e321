"""Pinhole cameras for depth, semantic classes and colours, and the bird's-eye grid."""

from __future__ import annotations

import math
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from cavmarl.config.rig import (
    BevGridConfig,
    CameraConfig,
    DepthCameraConfig,
    RgbCameraConfig,
    SemanticCameraConfig,
)
from cavmarl.core.math.elementary import hypot
from cavmarl.sensors.kernels.camera_picture import colours, make_camera, make_picture
from cavmarl.sensors.kernels.panorama import NUM_SEMANTICS
from cavmarl.sensors.kernels.polygon_fill import CameraPose
from cavmarl.sensors.kernels.rig_frames import Due
from cavmarl.sensors.kernels.rig_pictures import (
    camera_reach_m,
    fill_grids,
    make_birds_eye,
    take_pictures,
)
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mount_transforms import mount_matrix
from cavmarl.sensors.mounted.mounted_sensor import Bounds, ImagingSensor, Platform, SensedScene

C = TypeVar("C", bound=CameraConfig)


def camera_of(config: CameraConfig) -> CameraPose:
    """Return a camera's pose on its vehicle and its optics."""
    fov_rad = math.radians(config.fov_deg)
    return make_camera(mount_matrix(config), config.width, fov_rad, config.range_m)


class _Camera(ImagingSensor[C]):
    """Base class of the cameras."""

    kernel = take_pictures
    written_as: ClassVar[DTypeLike] = np.uint8
    _own: tuple[Any, ...]  # arguments `scratch` to `classes` of `take_pictures`

    def __init__(self, name: str, config: C, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._camera = camera_of(config)
        self._picture = make_picture(config.width, config.height, self._panorama)

    @staticmethod
    def reach_m(config: C, largest_radius_m: float) -> float:
        """Return the range at the picture's corners plus the largest radius of a body."""
        reach_m = camera_reach_m(camera_of(config), config.width, config.height)
        return reach_m + largest_radius_m

    @staticmethod
    def num_lines(config: C) -> int:
        return config.height

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        taken = (self._camera, self._panorama, self._picture, *self._own)
        data = frames.data.view(self.written_as)
        return (*self.view(scene, due), self.lines, self.noise, *taken, data)


class DepthCamera(_Camera[DepthCameraConfig]):
    """A camera that measures depth along the optical axis, as float16 in m."""

    dtype = np.float16
    written_as = np.uint16

    def __init__(self, name: str, config: DepthCameraConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        scratch = np.zeros(self._picture.face.shape, np.float32)
        self._own = (scratch, scratch.view(np.uint32), None, None)

    @staticmethod
    def bounds(config: DepthCameraConfig) -> Bounds:
        return np.zeros(config.shape), np.full(config.shape, config.range_m)


class SemanticCamera(_Camera[SemanticCameraConfig]):
    """A camera that returns the semantic class of each pixel; see `kernels.panorama`."""

    dtype = np.uint8
    _own = (None, None, None, True)

    @staticmethod
    def bounds(config: SemanticCameraConfig) -> Bounds:
        return np.zeros(config.shape), np.full(config.shape, NUM_SEMANTICS - 1.0)


class RgbCamera(_Camera[RgbCameraConfig]):
    """A camera that returns the colour of each pixel: the class's colour, shaded and hazy."""

    dtype = np.uint8
    _own = (None, None, colours(), None)

    @staticmethod
    def bounds(config: RgbCameraConfig) -> Bounds:
        return np.zeros(config.shape), np.full(config.shape, 255.0)


class BevGrid(ImagingSensor[BevGridConfig]):
    """Semantic classes from above, sampled at cell centres; see `kernels.panorama`."""

    dtype = np.uint8
    kernel = fill_grids

    def __init__(self, name: str, config: BevGridConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._grid = make_birds_eye(
            mount_matrix(config), config.ahead_m, config.aside_m, config.cell_m
        )
        self._reach_m = self.reach_m(config, 0.0)

    @staticmethod
    def bounds(config: BevGridConfig) -> Bounds:
        return np.zeros(config.shape), np.full(config.shape, NUM_SEMANTICS - 1.0)

    @staticmethod
    def reach_m(config: BevGridConfig, largest_radius_m: float) -> float:
        """Return the distance to the farthest corner plus the largest radius of a body."""
        farthest_m = hypot(max(config.ahead_m, config.behind_m), config.aside_m)
        return farthest_m + hypot(config.x_m, config.y_m) + largest_radius_m

    def arguments(self, scene: SensedScene, due: Due, frames: SensorFrames) -> tuple[Any, ...]:
        return (*self.view(scene, due), self._grid, self._reach_m, self._panorama, frames.data)
