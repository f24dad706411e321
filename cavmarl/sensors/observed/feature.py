"""What a sensor says of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from cavmarl.config.env import SensorsConfig
from cavmarl.driving.agent_view import AgentView


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
        reach_m: how far it looks for others, in m.
        shape: of its part of a Dict observation; -1 stands for all features.
        dtype: of that part.
        sees_bodies: whether it looks that far for any part of a body, and not for its centre.
        sense: of a sensor from outside of the package: its numbers, of an agent's view.
    """

    name: str
    features: Callable[[SensorsConfig], list[Feature]]
    reach_m: Callable[[SensorsConfig], float]
    shape: Callable[[SensorsConfig], tuple[int, ...]] = _flat
    dtype: Callable[[SensorsConfig], DTypeLike] = _float32
    sees_bodies: bool = False
    sense: Callable[[AgentView], ArrayLike] | None = None

    def reach_of_centres_m(self, config: SensorsConfig, largest_radius_m: float) -> float:
        """How far away the centre of a vehicle can be that the sensor can tell, in m.

        Args:
            config: the sensors.
            largest_radius_m: half the diagonal of the largest body.
        """
        reach_m = self.reach_m(config)
        return reach_m + largest_radius_m if reach_m > 0.0 and self.sees_bodies else reach_m
