"""The types of sensors, and what follows from a rig's settings alone.

A new type is a class in `config_rig`, a file beside this one, a kernel, and a line in `TYPES`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.rig import (
    BevGridConfig,
    CollisionConfig,
    DepthCameraConfig,
    GnssConfig,
    ImuConfig,
    LaneBoundaryConfig,
    LidarRigConfig,
    MountedConfig,
    OdometryConfig,
    RadarConfig,
    RgbCameraConfig,
    SemanticCameraConfig,
    samples_per_step,
)
from cavmarl.core.errors import ConfigError
from cavmarl.sensors.mounted.bev_grid import BevGrid
from cavmarl.sensors.mounted.cameras import DepthCamera, RgbCamera, SemanticCamera
from cavmarl.sensors.mounted.collision import Collision
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.gnss import Gnss
from cavmarl.sensors.mounted.imu import Imu
from cavmarl.sensors.mounted.lane_boundary import LaneBoundary
from cavmarl.sensors.mounted.lidar import Lidar
from cavmarl.sensors.mounted.mounted_sensor import MountedSensor, Platform
from cavmarl.sensors.mounted.odometry import Odometry
from cavmarl.sensors.mounted.radar import Radar

Shape = tuple[int, ...]

TYPES: dict[type[MountedConfig], type[MountedSensor[Any]]] = {
    LidarRigConfig: Lidar,
    RadarConfig: Radar,
    DepthCameraConfig: DepthCamera,
    SemanticCameraConfig: SemanticCamera,
    RgbCameraConfig: RgbCamera,
    BevGridConfig: BevGrid,
    GnssConfig: Gnss,
    ImuConfig: Imu,
    OdometryConfig: Odometry,
    LaneBoundaryConfig: LaneBoundary,
    CollisionConfig: Collision,
}


def type_of(name: str, config: MountedConfig) -> type[MountedSensor[Any]]:
    """The class of a sensor.

    Raises:
        ConfigError: there is none of that type.
    """
    try:
        return TYPES[type(config)]
    except KeyError:
        raise ConfigError(f"rig.{name}: no sensor of type {type(config).__name__}") from None


def mount(rig: Mapping[str, MountedConfig], platform: Platform) -> list[MountedSensor[Any]]:
    """The sensors of a rig, in its order."""
    return [type_of(name, config)(name, config, platform) for name, config in rig.items()]


def rig_reach_m(rig: Mapping[str, MountedConfig], largest_radius_m: float) -> float:
    """How far from an agent's centre the centre of a vehicle can be that its rig can tell, in m.

    `rig`: the sensors by name.
    """
    reaches = (
        type_of(name, config).reach_m(config, largest_radius_m) for name, config in rig.items()
    )
    return max(reaches, default=0.0)


def frame_layout(
    config: EnvConfig, num_worlds: int, prefix: str = "rig."
) -> dict[str, tuple[str, Shape]]:
    """Dtype as text, and shape, of all arrays of the frames of W worlds; see `frames_in`.

    `prefix`: begins their names.
    """
    clock, layout = config.clock, {}
    agents = (num_worlds, config.population.num_ids)
    for name, sensor in config.rig.items():
        slots = samples_per_step(sensor, clock.sim_dt_s, clock.ticks_per_step)
        samples = (*agents, slots)
        data = (np.dtype(type_of(name, sensor).dtype).str, (*samples, *sensor.shape))
        fields = (data, ("<f8", samples), ("|b1", samples), ("<i8", agents))
        for field, array in zip(SensorFrames._fields, fields, strict=True):
            layout[f"{prefix}{name}.{field}"] = array
    return layout


def frames_in(arrays: Mapping[str, NDArray[Any]], prefix: str = "rig.") -> dict[str, SensorFrames]:
    """The frames among arrays that are named as by `frame_layout`, by sensor."""
    found: dict[str, dict[str, NDArray[Any]]] = {}
    for key, array in arrays.items():
        if key.startswith(prefix):
            name, field = key.removeprefix(prefix).split(".")
            found.setdefault(name, {})[field] = array
    return {name: SensorFrames(**fields) for name, fields in found.items()}
