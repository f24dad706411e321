"""State of worlds that tests of signals read."""

from __future__ import annotations

from cavmarl.core.records.arrays import SharedState
from cavmarl.engine.simulation import Simulation


def common_of_worlds(simulation: Simulation) -> SharedState:
    """Ticks, signals and controllers that all zones share."""
    return simulation._tick.common
