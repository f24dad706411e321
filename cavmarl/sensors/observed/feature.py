"""`Sensor` and `Feature`: how a sensor that agents observe describes itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.sensor_setup import SensorSetup

Row = tuple[str, str, str]
"""Name, meaning and scale of a feature."""


@dataclass(frozen=True)
class Feature:
    """One number of an observation."""

    name: str  # unique within its sensor
    meaning: str  # what it is, with frame and sign
    scale: str = ""  # the number that 1.0 stands for, with its unit; empty for flags
    low: float = -1.0  # smallest value
    high: float = 1.0  # largest value


def features_of(rows: Iterable[Row]) -> list[Feature]:
    return [Feature(*row) for row in rows]


def numbered(count: int, subject: str, rows: Iterable[Row]) -> list[Feature]:
    """Return the rows of each of several things, one thing after the other."""
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


@dataclass(frozen=True)
class Sensor:
    """A sensor."""

    name: str  # its key
    # its features in order; none where it is switched off
    features: Callable[[SensorsConfig], list[Feature]]
    reach_m: Callable[[SensorsConfig], float] = _nowhere  # how far it looks for others, in m
    # of its part of a Dict observation; -1 stands for all features
    shape: Callable[[SensorsConfig], tuple[int, ...]] = _flat
    dtype: Callable[[SensorsConfig], DTypeLike] = _float32  # of that part
    # of an optional sensor, which `observe_optional` writes: what its kernel takes
    settings: Callable[[SensorSetup], tuple[Any, ...]] | None = None
    # whether it looks that far for any part of a body, and not for its centre
    sees_bodies: bool = False
    # of a sensor from outside of the package: its numbers, of a view of one agent, or of several
    sense: Callable[[Any], Any] | None = None
    batched: bool = False

    def reach_of_centres_m(self, config: SensorsConfig, largest_radius_m: float) -> float:
        """How far away the centre of a vehicle can be that the sensor can tell, in m."""
        reach_m = self.reach_m(config)
        return reach_m + largest_radius_m if reach_m > 0.0 and self.sees_bodies else reach_m
