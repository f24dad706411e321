"""All sensors by name: those that agents observe, those that vehicles carry, those from outside.

A new one that vehicles carry is a class in `config/rig.py`, one in `sensors/mounted/`, a kernel,
and a place in `TYPES`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.rig import MountedConfig, samples_per_step
from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.extensions import REGISTERED_SENSORS
from cavmarl.driving.agent_view import AgentView, BatchView
from cavmarl.sensors.mounted import cameras, lidar, own_motion
from cavmarl.sensors.mounted.frames import SensorFrames
from cavmarl.sensors.mounted.mounted_sensor import MountedSensor, Platform
from cavmarl.sensors.observed import SENSORS
from cavmarl.sensors.observed.feature import Feature, Sensor

MountedType = type[MountedSensor[Any]]

_CARRIED: tuple[MountedType, ...] = (
    lidar.Lidar,
    lidar.Radar,
    cameras.DepthCamera,
    cameras.SemanticCamera,
    cameras.RgbCamera,
    cameras.BevGrid,
    own_motion.Gnss,
    own_motion.Imu,
    own_motion.Odometry,
    own_motion.LaneBoundary,
    own_motion.Collision,
)
# By the class of settings that each one is generic in.
TYPES: dict[type[MountedConfig], MountedType] = {
    get_args(kind.__orig_bases__[0])[0]: kind  # type: ignore[attr-defined]
    for kind in _CARRIED
}
_MOUNTED = {f"rig.{config.type}": kind for config, kind in TYPES.items()}  # type: ignore[attr-defined]
_OBSERVED = {sensor.name: sensor for sensor in SENSORS}


def sensor_names() -> tuple[str, ...]:
    """All of them; those that vehicles carry as `rig.TYPE`."""
    return (*_OBSERVED, *REGISTERED_SENSORS.names, *_MOUNTED)


def register_sensor(
    name: str,
    sense: Callable[[AgentView], ArrayLike] | Callable[[BatchView], ArrayLike],
    *,
    features: Sequence[Feature],
    reach_m: float = 0.0,
    batched: bool = False,
) -> None:
    """Add a sensor that agents observe, which `sensors.registered` can name.

    Args:
        name: of the sensor.
        sense: its numbers, of an `AgentView` at the end of the step, one a feature; if `batched`,
            those of all agents (n, number of features), of a `BatchView`. They must not depend on
            the order of `AgentView.others`; that is checked when it is first used.
        features: what each number is; names are unique.
        reach_m: how far away the centres of `AgentView.others` can be; 0: it looks at none.
        batched: whether it answers for all agents of a world at once, and not once an agent.

    Raises:
        ConfigError: the name is taken, the reach is no distance, or features are missing or of one
            name.
    """
    if not 0.0 <= reach_m < math.inf:
        raise ConfigError(f"sensor '{name}': reach_m = {reach_m}: must be a distance from 0")
    listed = list(features)
    if not listed or len({feature.name for feature in listed}) < len(listed):
        raise ConfigError(f"sensor '{name}': features must be at least one, each of its own name")

    def features_of(config: SensorsConfig) -> list[Feature]:
        return listed if name in config.registered else []

    def reach_of(config: SensorsConfig) -> float:
        return float(reach_m)

    sensor = Sensor(name, features_of, reach_of, sense=sense, batched=batched)
    REGISTERED_SENSORS.add(name, sensor, sense, (*_OBSERVED, *_MOUNTED))


def type_of(name: str, config: MountedConfig) -> MountedType:
    """The class of a sensor.

    Raises ConfigError: there is none of that type.
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
) -> dict[str, tuple[str, tuple[int, ...]]]:
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
