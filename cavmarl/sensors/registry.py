"""All sensors by name: those that agents observe, those that vehicles carry, those from outside."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from numpy.typing import ArrayLike

from cavmarl.config.env import SensorsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.extensions import REGISTERED_SENSORS
from cavmarl.driving.agent_view import AgentView
from cavmarl.sensors.mounted.catalogue import TYPES
from cavmarl.sensors.mounted.mounted_sensor import MountedSensor
from cavmarl.sensors.observed import SENSORS
from cavmarl.sensors.observed.feature import Feature, Sensor

_MOUNTED = {f"rig.{config.type}": kind for config, kind in TYPES.items()}  # type: ignore[attr-defined]
_OBSERVED = {sensor.name: sensor for sensor in SENSORS}


def sensor_names() -> tuple[str, ...]:
    """All of them; those that vehicles carry as `rig.TYPE`."""
    return (*_OBSERVED, *REGISTERED_SENSORS.names, *_MOUNTED)


def find_sensor(name: str) -> Sensor | type[MountedSensor[Any]]:
    """The sensor of a name.

    Raises:
        ConfigError: there is none.
    """
    if name in _OBSERVED:
        return _OBSERVED[name]
    if name in _MOUNTED:
        return _MOUNTED[name]
    sensor: Sensor = REGISTERED_SENSORS[name]
    return sensor


def register_sensor(
    name: str,
    sense: Callable[[AgentView], ArrayLike],
    *,
    features: Sequence[Feature],
    reach_m: float = 0.0,
) -> None:
    """Add a sensor that agents observe, which `sensors.registered` can name.

    It is asked once a step and agent, in Python: slower than a sensor of the package.

    Args:
        name: of the sensor.
        sense: its numbers, of an `AgentView` at the end of the step, one a feature. They must not
            depend on the order of `view.others`; that is checked when it is first used.
        features: what each number is; names are unique.
        reach_m: how far away the centres of `view.others` can be; 0: it looks at none.

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

    sensor = Sensor(name, features_of, reach_of, sense=sense)
    REGISTERED_SENSORS.add(name, sensor, sense, (*_OBSERVED, *_MOUNTED))
