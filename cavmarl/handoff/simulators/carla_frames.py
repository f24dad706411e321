"""Frames of CARLA's sensors as samples of a rig: blueprints, poses and conversions."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.rig import (
    CameraConfig,
    LidarRigConfig,
    MountedConfig,
    RadarConfig,
    SampledConfig,
)
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
from cavmarl.sensors.mounted.lidar import azimuths, elevations
from cavmarl.sensors.mounted.mount_transforms import mount_matrix

BLUEPRINTS = {
    "rgb_camera": "sensor.camera.rgb",
    "depth_camera": "sensor.camera.depth",
    "semantic_camera": "sensor.camera.semantic_segmentation",
    "lidar": "sensor.lidar.ray_cast",
    "radar": "sensor.other.radar",
}
# types that are refused, since CARLA has no frames for them; cavmarl computes imu, gnss and so on
_NOT_GIVEN = ("bev_grid",)
MOST_RADAR_DEG = 179.0  # field of view of CARLA's radars
_RADAR_HEIGHT_DEG = 0.1  # CARLA's radars scan a cone, but a rig's radars scan a plane
# CARLA's lidar gets two columns per ray of the rig; only every other column lies on a ray.
_PER_RAY = 2
# Adjacent echoes belong to one target if they differ by at most these values.
_SAME_TARGET_M, _SAME_TARGET_MPS = 3.0, 1.0
_ON_GROUND_M = 0.2  # echoes below this height come from the ground
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
    """Return whether the samples of sensors come from CARLA."""
    return options.get("frames", "own") == "backend"


def check_option(options: Mapping[str, str]) -> None:
    """Check the option `frames`. Raises ConfigError."""
    if (value := options.get("frames", "own")) not in ("own", "backend"):
        raise ConfigError(
            f"zones.simulators: frames = {value!r}: must be own (cavmarl's models) or backend "
            "(CARLA's sensors)"
        )


def check_rig(zone: int, options: Mapping[str, str], rig: Mapping[str, MountedConfig]) -> None:
    """With `frames=backend`, check that CARLA can give the frames of a rig.

    Raises:
        ConfigError: the rig has a `bev_grid` (CARLA has no frames for it), a sensor with noise or
            bias whose frames come from CARLA, or a radar with a wider field of view than CARLA's.
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
                f"{where}: rig.{name} has noise or bias, which CARLA's frames do not get; set "
                "both to 0, or use frames=own"
            )
        if isinstance(sensor, RadarConfig) and sensor.fov_deg > MOST_RADAR_DEG:
            raise ConfigError(
                f"{where}: rig.{name}.fov_deg = {sensor.fov_deg:g}: a radar of CARLA covers at "
                f"most {MOST_RADAR_DEG:g} degrees; set a smaller angle, or use frames=own"
            )


def mounts_of(rig: Mapping[str, MountedConfig], dt_s: float) -> dict[str, dict[str, Any]]:
    """Return the blueprint, pose and attributes of each sensor of a rig, in CARLA's frame.

    `dt_s`: length of a tick; each sensor takes a whole frame in each tick.
    """
    found = {}
    for name, sensor in rig.items():
        if isinstance(sensor, CameraConfig):
            attributes = {
                "image_size_x": sensor.width,
                "image_size_y": sensor.height,
                "fov": sensor.fov_deg,
            }
        elif isinstance(sensor, LidarRigConfig):
            attributes = _lidar_attributes(sensor, dt_s)
        elif isinstance(sensor, RadarConfig):
            attributes = {
                "horizontal_fov": sensor.fov_deg,
                "vertical_fov": _RADAR_HEIGHT_DEG,
                "range": sensor.range_m,
                "points_per_second": round(sensor.rays / dt_s),
            }
        else:
            continue
        found[name] = {
            "blueprint": BLUEPRINTS[str(getattr(sensor, "type", ""))],
            "attributes": {key: str(value) for key, value in attributes.items()},
            "place": [sensor.x_m, -sensor.y_m, sensor.z_m],
            "turn": [sensor.pitch_deg, -sensor.yaw_deg, sensor.roll_deg],
        }
    return found


def _lidar_attributes(sensor: LidarRigConfig, dt_s: float) -> dict[str, float]:
    """Return the attributes of a lidar that turns once per tick and loses no points."""
    _, step_rad, rays = azimuths(sensor.fov_deg, sensor.rays)
    rising = np.degrees(elevations(sensor.lower_deg, sensor.upper_deg, sensor.layers))
    return {
        "channels": sensor.layers,
        "points_per_second": round(sensor.layers * _PER_RAY * rays / dt_s),
        "rotation_frequency": 1.0 / dt_s,
        "range": sensor.range_m,
        "lower_fov": float(rising[0]),
        "upper_fov": float(rising[-1]),
        "horizontal_fov": min(math.degrees(step_rad * rays), 360.0),
        "atmosphere_attenuation_rate": 0.0,
        "dropoff_general_rate": 0.0,
        "dropoff_zero_intensity": 0.0,
        "noise_stddev": 0.0,
    }


def sample_of(config: MountedConfig, frame: str) -> NDArray[Any]:
    """Return the sample of a sensor from the data of CARLA's frame in base64.

    The data of a camera are pixels: blue, green, red and alpha.
    """
    data = base64.b64decode(frame)
    if isinstance(config, LidarRigConfig):
        return _distances(config, np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3])
    if isinstance(config, RadarConfig):
        return _targets(config, np.frombuffer(data, "<f4").reshape(-1, 4))
    assert isinstance(config, CameraConfig)
    pixels = np.frombuffer(data, np.uint8).reshape(config.height, config.width, 4)
    match getattr(config, "type", ""):
        case "rgb_camera":
            return pixels[..., 2::-1].copy()
        case "depth_camera":
            blue, green, red = (pixels[..., n].astype(np.float64) for n in range(3))
            steps = red + 256.0 * green + 65536.0 * blue
            depth_m = steps / _DEPTH_STEPS * _FARTHEST_M
            return np.minimum(depth_m, config.range_m).astype(np.float16)
    return _CLASSES[pixels[..., 2]]


def _distances(config: LidarRigConfig, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the distances (layers, rays) from points (n, 3): ahead, to the right, upwards.

    Each ray uses the point in its direction; points between two rays are ignored.
    """
    ahead, right, up = points.astype(np.float64).T
    distance = np.sqrt(ahead * ahead + right * right + up * up)
    first, step, rays = azimuths(config.fov_deg, config.rays)
    half = 0.5 * (rays - 1)
    aside = np.arctan2(-right, ahead) - (first + step * half)  # angle from the middle of all rays
    beside = np.arctan2(np.sin(aside), np.cos(aside)) / step + half
    column = np.rint(beside).astype(np.int64)
    off = np.abs(beside - column)
    if config.fov_deg == 360.0:
        column %= rays
    rising = elevations(config.lower_deg, config.upper_deg, config.layers)
    layer = np.abs(np.arctan2(up, np.hypot(ahead, right))[:, np.newaxis] - rising).argmin(axis=1)
    kept = (distance < config.range_m) & (off <= 0.5 / _PER_RAY) & (column >= 0) & (column < rays)
    # Of several points, the closest to the ray is written last.
    order = np.flatnonzero(kept)
    order = order[np.argsort(-off[order], kind="stable")]
    found = np.full(config.shape, config.range_m, np.float32)
    found[layer[order], column[order]] = distance[order]
    return found


def _targets(config: RadarConfig, echoes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the targets (targets, 3) from echoes (n, 4): speed, azimuth, altitude and distance.

    Adjacent echoes with nearly the same place and speed belong to one target, whose nearest echo
    counts. Echoes of the ground are ignored, as in cavmarl's model.
    """
    speed, azimuth, altitude, distance = echoes.astype(np.float64).T
    azimuth = -azimuth  # CARLA's is clockwise
    level = distance * np.cos(altitude)
    x, y, z = level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(altitude)
    mount = mount_matrix(config)
    height_m = mount[2, 3] + np.stack([x, y, z], axis=1) @ mount[2, :3]
    kept = np.flatnonzero((height_m > _ON_GROUND_M) & (distance < config.range_m))
    kept = kept[np.argsort(azimuth[kept], kind="stable")]
    apart_m = np.hypot(np.diff(x[kept]), np.diff(y[kept]))
    is_other = (apart_m > _SAME_TARGET_M) | (np.abs(np.diff(speed[kept])) > _SAME_TARGET_MPS)
    groups = np.split(kept, np.flatnonzero(is_other) + 1) if len(kept) else []
    nearest = sorted((group[distance[group].argmin()] for group in groups), key=distance.item)
    chosen = np.array(nearest[: config.targets], np.int64)
    found = np.zeros(config.shape, np.float32)
    found[: len(chosen)] = np.stack([distance[chosen], azimuth[chosen], speed[chosen]], axis=1)
    return found
