"""What a sensor says of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cavmarl.config import SensorsConfig

__all__ = ["Feature", "Sensor"]


@dataclass(frozen=True)
class Feature:
    """One number of an observation.

    Attributes:
        name: unique within its sensor.
        meaning: what it is, with frame and sign.
        scale: the number that 1.0 stands for, with its unit; empty for flags.
    """

    name: str
    meaning: str
    scale: str = ""


@dataclass(frozen=True)
class Sensor:
    """A sensor: its key, its features in order, and how far it looks in m."""

    name: str
    features: Callable[[SensorsConfig], list[Feature]]
    reach_m: Callable[[SensorsConfig], float]
