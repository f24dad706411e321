"""How often vehicles touch: pairs of rectangles that begin to overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import make_grid
from cavmarl.driving.kernels.contacts import find_contacts

CELL_M = 10.0


class TouchCounter:
    """Counts the pairs that began to touch, tick by tick.

    Of several that touch one vehicle at once, only its pair with the lowest id counts.

    Args:
        bounds: min_x, min_y, max_x, max_y of the map in m.

    Attributes:
        count: pairs so far; one that parts and touches again counts again.
    """

    def __init__(self, bounds: tuple[float, float, float, float]) -> None:
        self.count = 0
        self._bounds = bounds
        self._make_room(0)
        self._touching: set[tuple[int, int]] = set()

    def see(self, rows: NDArray[np.void]) -> None:
        """Look at the vehicles of the next tick.

        Args:
            rows: VEHICLE (num_vehicles,).
        """
        if len(rows) > len(self._hit):
            self._make_room(2 * len(rows))
        find_contacts(rows, len(rows), self._grid, self._hit)
        hitting = np.flatnonzero(self._hit[: len(rows)] >= 0)
        ids, others = rows["id"][hitting].tolist(), self._hit[hitting].tolist()
        touching = {(min(pair), max(pair)) for pair in zip(ids, others, strict=True)}
        self.count += len(touching - self._touching)
        self._touching = touching

    def _make_room(self, capacity: int) -> None:
        self._grid = make_grid(self._bounds, CELL_M, capacity)
        self._hit = np.zeros(capacity, dtype=np.int64)
