"""`Sensor` and `Feature`: the description of a sensor that agents observe."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.sensor_setup import SensorSetup

Row = tuple[str, str, str]
"""Name, meaning and scale of a feature."""


@dataclass(frozen=True)
class Feature:
    """One number of an observation."""

    name: str  # unique within the sensor
    meaning: str  # meaning of the number, with frame and sign
    scale: str = ""  # the quantity that 1.0 stands for, with its unit; empty for flags
    low: float = -1.0  # smallest value
    high: float = 1.0  # largest value


def features_of(rows: Iterable[Row]) -> list[Feature]:
    return [Feature(*row) for row in rows]


def numbered(count: int, subject: str, rows: Iterable[Row]) -> list[Feature]:
    """Return the rows for each of `count` objects; `{}` in `subject` is the object's number."""
    listed = list(rows)
    return [
        Feature(f"{name}_{k}", f"{subject.format(k)}: {meaning}", scale)
        for k in range(count)
        for name, meaning, scale in listed
    ]


def _nowhere(config: SensorsConfig) -> float:
    return 0.0


def _flat(config: SensorsConfig) -> tuple[int, ...]:
    return (-1,)


def _float32(config: SensorsConfig) -> DTypeLike:
    return np.float32


Source = Literal["own vehicle", "ideal sensors", "map", "V2X", "world's state"]


@dataclass(frozen=True)
class Reading:
    """Something that an observation contains, and where a vehicle would have it from.

    Ideal sensors measure without errors. Nothing on a vehicle knows the world's state, such as the
    plans of other vehicles.
    """

    source: Source
    what: str


def hidden(through_walls: bool) -> str:
    """Return what hides vehicles from a sensor that vehicles do not block."""
    if through_walls:
        return "neither buildings nor vehicles hide them"
    return "buildings hide them, vehicles do not"


def _nothing(config: SensorsConfig) -> list[Reading]:
    return []


def _unchanged(config: SensorsConfig, name: str) -> str:
    return name


def _never(config: SensorsConfig) -> str:
    return ""


@dataclass(frozen=True)
class Sides:
    """What happens to a sensor's features if left and right are exchanged, as in a mirror."""

    # features whose sign changes, by name without the number at the end
    negated: tuple[str, ...] = ()
    # name of the feature whose value a feature gets
    partner: Callable[[SensorsConfig, str], str] = _unchanged
    # why these settings do not allow the exchange; empty: they do
    refusal: Callable[[SensorsConfig], str] = _never

    def is_negated(self, name: str) -> bool:
        return name in self.negated or name.rstrip("_0123456789") in self.negated


def left_for_right(config: SensorsConfig, name: str) -> str:
    """Return the name with `left` instead of `right`, and the reverse."""
    return "right".join(part.replace("right", "left") for part in name.split("left"))


@dataclass(frozen=True)
class Sensor:
    """A sensor that agents observe."""

    name: str  # its key in the configuration
    # its features in order; none if it is off
    features: Callable[[SensorsConfig], list[Feature]]
    reach_m: Callable[[SensorsConfig], float] = _nowhere  # sensing range, in m
    # shape of its part of a Dict observation; -1 stands for the number of features
    shape: Callable[[SensorsConfig], tuple[int, ...]] = _flat
    dtype: Callable[[SensorsConfig], DTypeLike] = _float32  # dtype of that part
    # arguments of the kernel, for an optional sensor, which `observe_optional` writes
    settings: Callable[[SensorSetup], tuple[Any, ...]] | None = None
    # whether the reach is to the nearest part of a body, not to its centre
    sees_bodies: bool = False
    # computes the numbers of a sensor of another package from an AgentView or a BatchView
    sense: Callable[[Any], Any] | None = None
    batched: bool = False
    # what it reads if it is on
    reads: Callable[[SensorsConfig], list[Reading]] = _nothing
    # what happens if left and right are exchanged; None: not known, or not possible
    sides: Sides | None = None

    def reach_of_centres_m(self, config: SensorsConfig, largest_radius_m: float) -> float:
        """Return the largest distance at which the sensor senses a vehicle's centre, in m."""
        reach_m = self.reach_m(config)
        return reach_m + largest_radius_m if reach_m > 0.0 and self.sees_bodies else reach_m
