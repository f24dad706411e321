"""Cameras: depth, classes and colours of what a pinhole camera shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from cavmarl.config.rig import (
    CameraConfig,
    DepthCameraConfig,
    RgbCameraConfig,
    SemanticCameraConfig,
)
from cavmarl.core.numba.specialized import specialized
from cavmarl.sensors.kernels.camera_picture import make_camera, make_picture
from cavmarl.sensors.kernels.panorama import make_panorama
from cavmarl.sensors.kernels.pixels import colours
from cavmarl.sensors.kernels.rig_pictures import (
    camera_reach_m,
    take_classes,
    take_colours,
    take_depths,
)
from cavmarl.sensors.kernels.rig_schedule import Due
from cavmarl.sensors.kernels.semantics import NUM_SEMANTICS
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mount_transforms import mount_matrix
from cavmarl.sensors.mounted.mounted_sensor import (
    Bounds,
    MountedSensor,
    Platform,
    SensedScene,
    noise_of,
)

C = TypeVar("C", bound=CameraConfig)


class _Camera(MountedSensor[C]):
    """What all cameras have."""

    def __init__(self, name: str, config: C, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._noise = noise_of(name, config)
        self._camera = make_camera(
            mount_matrix(config), config.width, math.radians(config.fov_deg), config.range_m
        )
        self._backdrop = platform.backdrop
        self._panorama = make_panorama(platform.backdrop, platform.capacity)
        self._picture = make_picture(config.width, config.height, self._panorama)

    @staticmethod
    def reach_m(config: C, largest_radius_m: float) -> float:
        """The range in the corners of the picture, to the nearest side of a body."""
        camera = make_camera(
            mount_matrix(config), config.width, math.radians(config.fov_deg), config.range_m
        )
        return camera_reach_m(camera, config.width, config.height) + largest_radius_m

    @staticmethod
    def num_lines(config: C) -> int:
        """The rows of the picture."""
        return config.height


class DepthCamera(_Camera[DepthCameraConfig]):
    """Depth along the optical axis, as float16 in m."""

    dtype = np.float16

    def __init__(self, name: str, config: DepthCameraConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._room = np.zeros(self._picture.face.shape, np.float32)
        self._take = specialized(take_depths)

    @staticmethod
    def bounds(config: DepthCameraConfig) -> Bounds:
        """From 0 to the range."""
        return np.zeros(config.shape), np.full(config.shape, config.range_m)

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._take(
                scene.worlds,
                scene.grid,
                self._backdrop,
                due,
                self.lines,
                self._noise,
                self._camera,
                self._panorama,
                self._picture,
                self._room,
                self._room.view(np.uint32),
                frames.data.view(np.uint16),
            )


class SemanticCamera(_Camera[SemanticCameraConfig]):
    """The class of what each pixel shows; see `kernels.semantics`."""

    dtype = np.uint8

    def __init__(self, name: str, config: SemanticCameraConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._take = specialized(take_classes)

    @staticmethod
    def bounds(config: SemanticCameraConfig) -> Bounds:
        """The classes."""
        return np.zeros(config.shape), np.full(config.shape, NUM_SEMANTICS - 1.0)

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._take(
                scene.worlds,
                scene.grid,
                self._backdrop,
                due,
                self.lines,
                self._camera,
                self._panorama,
                self._picture,
                frames.data,
            )


class RgbCamera(_Camera[RgbCameraConfig]):
    """The colour of each pixel: that of its class, in the light of its face and the haze."""

    dtype = np.uint8

    def __init__(self, name: str, config: RgbCameraConfig, platform: Platform) -> None:
        super().__init__(name, config, platform)
        self._palette = colours()
        self._take = specialized(take_colours)

    @staticmethod
    def bounds(config: RgbCameraConfig) -> Bounds:
        """From 0 to 255."""
        return np.zeros(config.shape), np.full(config.shape, 255.0)

    def sense(self, scenes: Sequence[SensedScene], due: Due, frames: SensorFrames) -> None:
        """Write what is due."""
        for scene in scenes:
            self._take(
                scene.worlds,
                scene.grid,
                self._backdrop,
                due,
                self.lines,
                self._noise,
                self._camera,
                self._panorama,
                self._picture,
                self._palette,
                frames.data,
            )
