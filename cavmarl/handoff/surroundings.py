"""`NearBorders`: what rows of transfers need to know of the world, and the core does not."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

from cavmarl.handoff.coordinator.coordinator import Near
from cavmarl.handoff.division import Division


class NearBorders:
    """Vehicles near a border when the tick began, and those that have crossed one.

    Attributes:
        near: of the tick that is on its way; to be set.
        places: vehicle that has changed its owner in it → the row that it had there; to be set.
    """

    def __init__(self, division: Division, world: int) -> None:
        self.places: Mapping[int, int] = {}
        self._division = division
        self._world = world
        self.near: Sequence[Near] = ()
        self._depths: dict[tuple[int, int], float] = {}
        self._told: Sequence[Near] = ()

    def depth_m(self, vehicle: int, target: int) -> float | None:
        """How far outside of its owner's zone, less than 0 inside; None: it was not near."""
        if self._told is not self.near:
            self._told = self.near
            self._depths = {(entry.vehicle, entry.target): entry.depth_m for entry in self.near}
        return self._depths.get((vehicle, target))

    def release_depth_m(self, vehicle: int, source: int, target: int) -> float | None:
        """How far outside of its old zone a vehicle is that has changed; None: it has left."""
        hint = self.places.get(vehicle, 0)
        return self._division.depth_m(self._world, vehicle, target, source, hint)

    @staticmethod
    def now_ms() -> float:
        """Of the process's clock."""
        return 1e3 * time.perf_counter()
