"""Simulators of zones in a module that worker processes and nodes can import.

The import registers `exact_zone`, which moves vehicles as cavmarl does, and three simulators that
refuse vehicles or fail.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

import cavmarl
from tests.support.zone_simulators import OwnKinematics

EXACT, HESITANT = "exact_zone", "hesitant_zone"
UNWILLING, FAILING = "unwilling_zone", "failing_zone"


class Exact(OwnKinematics):
    """A simulator that moves each vehicle as cavmarl does."""


class Hesitant(OwnKinematics):
    """A simulator that refuses each vehicle twice before it accepts it."""

    times = 2

    def prepare(self, vehicles: NDArray[np.void]) -> Mapping[int, str]:
        super().prepare(vehicles)
        ids = vehicles["id"].tolist()
        for vehicle in ids:
            self.counts[f"asked for {vehicle}"] += 1
        asked = {vehicle: self.counts[f"asked for {vehicle}"] for vehicle in ids}
        refused = [vehicle for vehicle, times in asked.items() if times <= self.times]
        for vehicle in set(ids) - set(refused):
            self.counts[f"asked for {vehicle}"] = 0
        return dict.fromkeys(refused, "the place is occupied")


class Unwilling(Hesitant):
    """A simulator that accepts no vehicle."""

    times = 10**6


class Failing(OwnKinematics):
    """A simulator that fails in its 100th tick.

    A worker repeats up to 64 steps after a failure, so it reaches tick 100 only once.
    """

    def read(self) -> NDArray[np.void]:
        self.counts["read"] += 1
        if self.counts["read"] == 100:
            raise OSError("connection lost")
        return super().read()


for name, kind in (
    (EXACT, Exact),
    (HESITANT, Hesitant),
    (UNWILLING, Unwilling),
    (FAILING, Failing),
):
    cavmarl.register_zone_simulator(name, kind)
