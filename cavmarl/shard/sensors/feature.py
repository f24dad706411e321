"""What a sensor says of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from cavmarl.config import SensorsConfig

__all__ = ["Feature", "Sensor"]


@dataclass(frozen=True)
class Feature:
    """One number of an observation.

    Attributes:
        name: unique within its sensor.
        meaning: what it is, with frame and sign.
        scale: the number that 1.0 stands for, with its unit; empty for flags.
        low: smallest value.
        high: largest value.
    """

    name: str
    meaning: str
    scale: str = ""
    low: float = -1.0
    high: float = 1.0


def _flat(config: SensorsConfig) -> tuple[int, ...]:
    return (-1,)


def _float32(config: SensorsConfig) -> DTypeLike:
    return np.float32


@dataclass(frozen=True)
class Sensor:
    """A sensor.

    Attributes:
        name: its key.
        features: its features in order; none where it is switched off.
        reach_m: how far it looks, in m.
        shape: of its part of a Dict observation; -1 stands for all features.
        dtype: of that part.
    """

    name: str
    features: Callable[[SensorsConfig], list[Feature]]
    reach_m: Callable[[SensorsConfig], float]
    shape: Callable[[SensorsConfig], tuple[int, ...]] = _flat
    dtype: Callable[[SensorsConfig], DTypeLike] = _float32
