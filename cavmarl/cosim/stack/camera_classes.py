"""Perception by lidar and camera: echoes are grouped into objects, the camera gives their class.

Echoes of an object are projected into the newest picture of each semantic camera, at three heights
of a body. The most frequent class of these pixels is the object's class (late fusion, as in Vora
et al.: "PointPainting", CVPR 2020, with a segmented picture). From the camera's place, nearer
objects may hide some echoes; these are not counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.perception import LidarObjects
from cavmarl.cosim.stack.stack_types import EgoPose, Readings, StackSensor
from cavmarl.sensors.kernels.panorama import SEMANTIC_NAMES
from cavmarl.sensors.mounted.mount_transforms import mount_rotation

_HEIGHTS_M = (0.3, 0.7, 1.1)  # heights above the ground
_NEAREST_M = 0.5  # minimum depth in front of the camera
_BEHIND_M = 2.0  # echoes this much deeper than the nearest one in their column may be hidden
_KINDS = {
    "building": "building",
    "car": "vehicle",
    "truck": "vehicle",
    "bus": "vehicle",
    "tram": "vehicle",
    "motorcycle": "vehicle",
    "bicycle": "cyclist",
    "pedestrian": "pedestrian",
}
KIND_OF_CLASS = tuple(_KINDS.get(name, "") for name in SEMANTIC_NAMES)


class _Camera(NamedTuple):
    """A camera: its pose on the vehicle, and its focal length in pixels."""

    sensor: StackSensor
    turn: NDArray[np.float64]  # (3, 3)
    place_m: NDArray[np.float64]  # (3,) in the vehicle's frame
    focal_px: float


class LidarCamera(LidarObjects):
    """The perception stage `lidar_camera`.

    `sensors`: sensors of the vehicle: lidars, and at least one semantic camera.

    Raises ConfigError: there is no semantic camera.
    """

    def __init__(self, sensors: Sequence[StackSensor], hd_map: HdMap) -> None:
        super().__init__(sensors, hd_map)
        self._cameras = [_camera(sensor) for sensor in sensors if sensor.type == "semantic_camera"]
        if not self._cameras:
            raise ConfigError(
                "perception = lidar_camera: there is no semantic_camera among the sensors; mount "
                "one under `rig`, as {eyes: {type: semantic_camera, rate_hz: 10, z_m: 1.4}}"
            )
        self._pictures: dict[str, NDArray[np.uint8]] = {}
        self._covered_m: dict[str, NDArray[np.float64]] = {}  # by column, see `_pixels`
        self._pose = EgoPose(0.0, 0.0, 0.0, 0.0)

    def _read_others(
        self, readings: Readings, pose: EgoPose, groups: Sequence[NDArray[np.float64]]
    ) -> None:
        self._pose = pose
        echoes = self._in_vehicle(np.concatenate(groups))
        for camera in self._cameras:
            samples = readings.get(camera.sensor.name)
            if samples is not None and not samples.lost.all():
                newest = samples.values[~samples.lost][-1]
                self._pictures[camera.sensor.name] = np.asarray(newest, dtype=np.uint8)
            width = int(camera.sensor.settings["width"])
            ahead_m, column, _ = _projected(camera, echoes)
            nearest_m = np.full(width + 2, np.inf)  # plus one column on either side
            np.minimum.at(nearest_m, np.clip(column, -1, width) + 1, ahead_m)
            self._covered_m[camera.sensor.name] = _BEHIND_M + np.minimum.reduce(
                [nearest_m[:-2], nearest_m[1:-1], nearest_m[2:]]
            )

    def _kind(self, group: NDArray[np.float64]) -> str:
        """Return the most frequent kind in the pixels of echoes (n, 2) on the map, or unknown."""
        votes = np.zeros(len(SEMANTIC_NAMES), np.int64)
        for camera in self._cameras:
            picture = self._pictures.get(camera.sensor.name)
            if picture is not None:
                covered_m = self._covered_m[camera.sensor.name]
                classes = _pixels(camera, picture, covered_m, self._in_vehicle(group))
                votes += np.bincount(classes, minlength=len(votes))[: len(votes)]
        votes[[number for number, kind in enumerate(KIND_OF_CLASS) if not kind]] = 0
        return KIND_OF_CLASS[int(votes.argmax())] if votes.any() else "unknown"

    def _in_vehicle(self, group: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return echoes in the frame of the vehicle, (3 n, 3), at three heights each."""
        cos, sin = math.cos(self._pose.heading_rad), math.sin(self._pose.heading_rad)
        plane = (group - (self._pose.x_m, self._pose.y_m)) @ np.array([[cos, -sin], [sin, cos]])
        return np.concatenate(
            [np.column_stack([plane, np.full(len(plane), height)]) for height in _HEIGHTS_M]
        )


def _camera(sensor: StackSensor) -> _Camera:
    settings = sensor.settings
    turn = mount_rotation(settings["yaw_deg"], settings["pitch_deg"], settings["roll_deg"])
    place_m = np.array([settings["x_m"], settings["y_m"], settings["z_m"]])
    focal_px = 0.5 * settings["width"] / math.tan(0.5 * math.radians(settings["fov_deg"]))
    return _Camera(sensor, turn, place_m, focal_px)


def _projected(
    camera: _Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return depth in m, column and row of points (n, 3) of the vehicle's frame in a picture."""
    ahead, left, up = ((points - camera.place_m) @ camera.turn).T
    seen = ahead > _NEAREST_M
    settings = camera.sensor.settings
    column = np.floor(0.5 * settings["width"] - camera.focal_px * left[seen] / ahead[seen])
    row = np.floor(0.5 * settings["height"] - camera.focal_px * up[seen] / ahead[seen])
    return ahead[seen], column.astype(np.int64), row.astype(np.int64)


def _pixels(
    camera: _Camera,
    picture: NDArray[np.uint8],
    covered_m: NDArray[np.float64],
    points: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Return the classes of the pixels that points (n, 3) of the vehicle's frame project to.

    `covered_m`: by column, the depth beyond which a point may be hidden behind another point.
    """
    ahead_m, column, row = _projected(camera, points)
    height, width = picture.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside[inside] = ahead_m[inside] <= covered_m[column[inside]]
    found: NDArray[np.uint8] = picture[row[inside], column[inside]]
    return found
