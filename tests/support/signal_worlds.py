"""Access to internal signal data of worlds for tests."""

from __future__ import annotations

from cavmarl.core.records.arrays import SharedState
from cavmarl.engine.simulation import Simulation


def common_of_worlds(simulation: Simulation) -> SharedState:
    """Return the ticks, signals and controllers that all zones share."""
    return simulation._tick.common
