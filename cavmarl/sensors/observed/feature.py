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
    scale: str = ""  # the quantity that is scaled to 1.0, with its unit; empty for flags
    low: float = -1.0  # smallest value
    high: float = 1.0  # largest value


def features_of(rows: Iterable[Row]) -> list[Feature]:
    return [Feature(*row) for row in rows]


def numbered(count: int, subject: str, rows: Iterable[Row]) -> list[Feature]:
    """Return the features of `count` objects; `{}` in `subject` stands for the object's number."""
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
    """A kind of information in an observation, and the source that a vehicle would have for it.

    Ideal sensors measure without errors. No device on a vehicle knows the world's state, such as
    the plans of other vehicles.
    """

    source: Source
    what: str


def hidden(through_walls: bool) -> str:
    """Return what hides vehicles from a sensor that sees through other vehicles."""
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
    """The change of a sensor's features if left and right are exchanged, as in a mirror."""

    # features whose sign changes, by name without the number at the end
    negated: tuple[str, ...] = ()
    # for the name of a feature, the name of the feature whose value it gets
    partner: Callable[[SensorsConfig, str], str] = _unchanged
    # reason why the settings do not allow the exchange; empty if they do
    refusal: Callable[[SensorsConfig], str] = _never

    def is_negated(self, name: str) -> bool:
        return name in self.negated or name.rstrip("_0123456789") in self.negated


def left_for_right(config: SensorsConfig, name: str) -> str:
    """Exchange `left` and `right` in a name."""
    return "right".join(part.replace("right", "left") for part in name.split("left"))


@dataclass(frozen=True)
class Sensor:
    """A sensor that agents observe."""

    name: str  # key in the configuration
    # features in order; none if the sensor is off
    features: Callable[[SensorsConfig], list[Feature]]
    reach_m: Callable[[SensorsConfig], float] = _nowhere  # sensing range, in m
    # shape of the sensor's part of a Dict observation; -1 stands for the number of features
    shape: Callable[[SensorsConfig], tuple[int, ...]] = _flat
    dtype: Callable[[SensorsConfig], DTypeLike] = _float32  # dtype of that part
    # arguments of the kernel `observe_optional` for this sensor; None: it does not write the sensor
    settings: Callable[[SensorSetup], tuple[Any, ...]] | None = None
    # whether the reach is measured to the nearest part of a body, not to its centre
    sees_bodies: bool = False
    # computes the numbers of a sensor of another package from an AgentView or a BatchView
    sense: Callable[[Any], Any] | None = None
    batched: bool = False
    # what the sensor reads if it is on
    reads: Callable[[SensorsConfig], list[Reading]] = _nothing
    # change of the features if left and right are exchanged; None: not known, or not possible
    sides: Sides | None = None

    def reach_of_centres_m(self, config: SensorsConfig, largest_radius_m: float) -> float:
        """Return the largest distance at which the sensor senses a vehicle's centre, in m."""
        reach_m = self.reach_m(config)
        return reach_m + largest_radius_m if reach_m > 0.0 and self.sees_bodies else reach_m
