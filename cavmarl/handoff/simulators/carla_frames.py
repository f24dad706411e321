"""Frames of CARLA's cameras as samples of a rig: blueprints, poses and conversions."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.rig import CameraConfig, MountedConfig, SampledConfig
from cavmarl.core.errors import ConfigError
from cavmarl.sensors.kernels.panorama import (
    BICYCLE,
    BUILDING,
    BUS,
    CAR,
    GROUND,
    MOTORCYCLE,
    NOTHING,
    PEDESTRIAN,
    ROAD,
    TRAM,
    TRUCK,
)

BLUEPRINTS = {
    "rgb_camera": "sensor.camera.rgb",
    "depth_camera": "sensor.camera.depth",
    "semantic_camera": "sensor.camera.semantic_segmentation",
}
_NOT_GIVEN = ("lidar", "radar", "bev_grid")  # sensors of the surroundings without such frames
_FARTHEST_M = 1000.0
_DEPTH_STEPS = (1 << 24) - 1
_CLASS_OF_TAG = {
    0: NOTHING, 1: ROAD, 2: GROUND, 10: GROUND, 11: NOTHING, 12: PEDESTRIAN, 13: PEDESTRIAN,
    14: CAR, 15: TRUCK, 16: BUS, 17: TRAM, 18: MOTORCYCLE, 19: BICYCLE, 23: GROUND, 24: ROAD,
    25: GROUND, 27: GROUND,
}  # fmt: skip
_CLASSES = np.full(256, BUILDING, np.uint8)  # all other tags are obstacles
for _tag, _class in _CLASS_OF_TAG.items():
    _CLASSES[_tag] = _class


def gives_frames(options: Mapping[str, str]) -> bool:
    """Return whether the samples of cameras come from CARLA."""
    return options.get("frames", "own") == "backend"


def check_option(options: Mapping[str, str]) -> None:
    """Check the option `frames`. Raises ConfigError."""
    if (value := options.get("frames", "own")) not in ("own", "backend"):
        raise ConfigError(
            f"zones.simulators: frames = {value!r}: must be own (cavmarl's models) or backend "
            "(CARLA's cameras)"
        )


def check_rig(zone: int, options: Mapping[str, str], rig: Mapping[str, MountedConfig]) -> None:
    """Check that CARLA's cameras can take the samples of a rig, if that is wanted.

    Raises:
        ConfigError: the rig has a sensor of the surroundings of which CARLA gives no frames, or a
            camera with noise.
    """
    if not gives_frames(options):
        return
    where = f"zones.simulators.{zone}: frames=backend"
    for name, sensor in rig.items():
        kind = getattr(sensor, "type", "")
        if kind in _NOT_GIVEN:
            raise ConfigError(
                f"{where}: rig.{name} is of type {kind}; a CARLA server gives frames of "
                f"{', '.join(BLUEPRINTS)} only. Leave the sensor out, or use frames=own"
            )
        is_noisy = isinstance(sensor, SampledConfig) and any((*sensor.noise, *sensor.bias))
        if kind in BLUEPRINTS and is_noisy:
            raise ConfigError(
                f"{where}: rig.{name} has noise or bias, which CARLA's pictures do not get; set "
                "both to 0, or use frames=own"
            )


def cameras_of(rig: Mapping[str, MountedConfig]) -> dict[str, dict[str, Any]]:
    """Return what the client needs to mount each camera of a rig, in CARLA's frame."""
    found = {}
    for name, sensor in rig.items():
        if not isinstance(sensor, CameraConfig):
            continue
        found[name] = {
            "blueprint": BLUEPRINTS[str(getattr(sensor, "type", ""))],
            "attributes": {
                "image_size_x": str(sensor.width),
                "image_size_y": str(sensor.height),
                "fov": str(sensor.fov_deg),
            },
            "place": [sensor.x_m, -sensor.y_m, sensor.z_m],
            "turn": [sensor.pitch_deg, -sensor.yaw_deg, sensor.roll_deg],
        }
    return found


def sample_of(config: CameraConfig, picture: str) -> NDArray[Any]:
    """Return the sample of a camera from CARLA's pixels: blue, green, red and alpha in base64."""
    data = np.frombuffer(base64.b64decode(picture), np.uint8)
    pixels = data.reshape(config.height, config.width, 4)
    match getattr(config, "type", ""):
        case "rgb_camera":
            return pixels[..., 2::-1].copy()
        case "depth_camera":
            blue, green, red = (pixels[..., n].astype(np.float64) for n in range(3))
            steps = red + 256.0 * green + 65536.0 * blue
            depth_m = steps / _DEPTH_STEPS * _FARTHEST_M
            return np.minimum(depth_m, config.range_m).astype(np.float16)
    return _CLASSES[pixels[..., 2]]
