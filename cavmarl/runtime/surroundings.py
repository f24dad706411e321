"""`NearBorders`: what rows of transfers need to know of the world, and the core does not."""

from __future__ import annotations

import time
from collections.abc import Sequence

from cavmarl.runtime.referee import Near

__all__ = ["NearBorders"]


class NearBorders:
    """Who was near a border when the tick began.

    Attributes:
        near: of the tick that is on its way; to be set.
    """

    def __init__(self) -> None:
        self.near: Sequence[Near] = ()
        self._depths: dict[tuple[int, int], float] = {}
        self._told: Sequence[Near] = ()

    def depth_m(self, vehicle: int, target: int) -> float | None:
        """How far outside of its owner's zone, less than 0 inside; None: it was not near."""
        if self._told is not self.near:
            self._told = self.near
            self._depths = {(entry.vehicle, entry.target): entry.depth_m for entry in self.near}
        return self._depths.get((vehicle, target))

    @staticmethod
    def now_ms() -> float:
        """Of the process's clock."""
        return 1e3 * time.perf_counter()
