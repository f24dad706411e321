"""Observations of a `TrafficSignal`: the base class for your own, and sumo-rl's default."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

if TYPE_CHECKING:
    from cavmarl.adapters.sumo_rl.environment.traffic_signal import TrafficSignal


class ObservationFunction(ABC):
    """Base class of observations; a subclass is the argument `observation_class`.

    Args:
        ts: the signal to observe.
    """

    def __init__(self, ts: TrafficSignal) -> None:
        self.ts = ts

    @abstractmethod
    def __call__(self) -> NDArray[Any]:
        """Return the observation."""

    @abstractmethod
    def observation_space(self) -> spaces.Space[Any]:
        """Return the space of the observations."""


class DefaultObservationFunction(ObservationFunction):
    """The green in one-hot encoding, whether it may end, and densities on incoming lanes.

    First come the densities of all vehicles, then the densities of stopped vehicles.
    """

    def __call__(self) -> NDArray[np.float32]:
        """Return the observation."""
        ts = self.ts
        greens = [float(ts.green_phase == green) for green in range(ts.num_green_phases)]
        may_end = float(ts.time_since_last_phase_change >= ts.min_green + ts.yellow_time)
        values = [*greens, may_end, *ts.get_lanes_density(), *ts.get_lanes_queue()]
        return np.array(values, dtype=np.float32)

    def observation_space(self) -> spaces.Box:
        """Return a Box from 0 to 1."""
        size = self.ts.num_green_phases + 1 + 2 * len(self.ts.lanes)
        return spaces.Box(0.0, 1.0, (size,), np.float32)
