"""`SensorSetup`: the inputs for the settings of an optional sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.math.walls import Walls, make_walls
from cavmarl.roads.network import RoadNetwork


@dataclass(frozen=True)
class SensorSetup:
    """The world of a sensor, and the position of its features in a frame."""

    config: SensorsConfig
    at: int  # index of the sensor's first feature in a frame
    network: RoadNetwork
    goals: NDArray[np.float64]  # see `highway.goal_places`
    most_told: int  # number of vehicles that an inbox keeps
    capacity: int  # rows per world


def walls_of(network: RoadNetwork, through_walls: bool) -> Walls:
    """Return the walls that hide vehicles; none if the sensor sees through walls."""
    walls = network.walls[:0] if through_walls else network.walls
    return make_walls(np.stack([walls[name] for name in ("ax", "ay", "bx", "by")], axis=1))
