"""The registry of sensors: observed by agents, mounted on vehicles, or added by other packages.

A new mounted sensor needs a settings class in `config/rig.py` that is part of the union
`RigSensor`, a class in `sensors/mounted/`, a kernel, and an entry in `_CARRIED`.
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
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides

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
# The key is the class of settings, which is the type argument of the sensor's base class.
TYPES: dict[type[MountedConfig], MountedType] = {
    get_args(kind.__orig_bases__[0])[0]: kind  # type: ignore[attr-defined]
    for kind in _CARRIED
}
_MOUNTED = {f"rig.{config.type}": kind for config, kind in TYPES.items()}  # type: ignore[attr-defined]
_OBSERVED = {sensor.name: sensor for sensor in SENSORS}


def sensor_names() -> tuple[str, ...]:
    """Return the names of all sensors; mounted sensors are named `rig.TYPE`."""
    return (*_OBSERVED, *REGISTERED_SENSORS.names, *_MOUNTED)


def register_sensor(
    name: str,
    sense: Callable[[AgentView], ArrayLike] | Callable[[BatchView], ArrayLike],
    *,
    features: Sequence[Feature],
    reach_m: float = 0.0,
    batched: bool = False,
    sides: Sides | None = None,
) -> None:
    """Register a sensor that agents observe; `sensors.registered` can then name it.

    Args:
        name: name of the sensor.
        sense: returns one number per feature for an `AgentView` at the end of the step; if
            `batched`, an array (n, number of features) for a `BatchView` of n agents. The numbers
            must not depend on the order of `AgentView.others`; this is checked at the first use.
        features: meaning of each number; names are unique.
        reach_m: `AgentView.others` has the vehicles whose centres are within this distance of the
            agent's centre; if 0, it is empty.
        batched: whether `sense` is called once per world, with all agents, instead of once per
            agent.
        sides: how the features change in a world in which left and right are exchanged. Without
            `sides`, trained drivers that observe the sensor cannot drive on the other side of the
            road.

    Raises:
        ConfigError: the name is taken, `reach_m` is negative or infinite, `features` is empty, or
            two features have the same name.
    """
    if not 0.0 <= reach_m < math.inf:
        raise ConfigError(f"sensor '{name}': reach_m = {reach_m} must be finite and at least 0")
    listed = list(features)
    if not listed or len({feature.name for feature in listed}) < len(listed):
        raise ConfigError(f"sensor '{name}': give at least one feature, each with a unique name")

    def features_of(config: SensorsConfig) -> list[Feature]:
        return listed if name in config.registered else []

    def reach_of(config: SensorsConfig) -> float:
        return float(reach_m)

    def reads(config: SensorsConfig) -> list[Reading]:
        others = f", from vehicles within {reach_m:g} m" if reach_m else ""
        return [Reading("ideal sensors", f"the registered sensor {name}{others}")]

    sensor = Sensor(
        name, features_of, reach_of, sense=sense, batched=batched, sides=sides, reads=reads
    )
    REGISTERED_SENSORS.add(name, sensor, sense, (*_OBSERVED, *_MOUNTED))


def type_of(name: str, config: MountedConfig) -> MountedType:
    """Return the class of a mounted sensor.

    Raises ConfigError: there is no sensor for this class of settings.
    """
    try:
        return TYPES[type(config)]
    except KeyError:
        raise ConfigError(f"rig.{name}: no sensor has settings {type(config).__name__}") from None


def mount(rig: Mapping[str, MountedConfig], platform: Platform) -> list[MountedSensor[Any]]:
    """Create the sensors of a rig, in the rig's order."""
    return [type_of(name, config)(name, config, platform) for name, config in rig.items()]


def rig_reach_m(rig: Mapping[str, MountedConfig], largest_radius_m: float) -> float:
    """Return the largest distance at which a rig can sense a vehicle, centre to centre, in m.

    `rig`: settings of the sensors, by name.
    """
    reaches = (
        type_of(name, config).reach_m(config, largest_radius_m) for name, config in rig.items()
    )
    return max(reaches, default=0.0)


def frame_layout(
    config: EnvConfig, num_worlds: int, prefix: str = "rig."
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return the dtype (as text) and shape of all frame arrays of W worlds; see `frames_in`.

    `prefix`: start of each array's name.
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
    """Collect the arrays of `frame_layout` into frames, by sensor."""
    found: dict[str, dict[str, NDArray[Any]]] = {}
    for key, array in arrays.items():
        if key.startswith(prefix):
            name, field = key.removeprefix(prefix).split(".")
            found.setdefault(name, {})[field] = array
    return {name: SensorFrames(**fields) for name, fields in found.items()}
