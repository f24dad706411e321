"""`LineCosts`: the costs of the lines of sensor frames, as workers measure them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

PARTS = 32  # parts of a frame; lines of one part count as equally expensive


class LineCosts:
    """Relative costs of the lines of each frame; initially all are equal."""

    def __init__(self, num_lines: Sequence[int]) -> None:
        self._num_lines = tuple(num_lines)
        self._parts = np.full((len(num_lines), PARTS), 1.0 / PARTS)

    def part(self, sensor: int, begin: int, end: int) -> float:
        """Return the cost of the lines [begin, end) as a share of the frame."""
        return float(self._parts[sensor] @ self._covered(sensor, begin, end))

    def line_at(self, sensor: int, part: float) -> int:
        """Return the line such that the lines before it cost about this share of the frame."""
        before = np.concatenate([[0.0], np.cumsum(self._parts[sensor])])
        place = np.interp(part, before, np.arange(PARTS + 1.0))
        return round(float(place) / PARTS * self._num_lines[sensor])

    def learn(
        self,
        sensor: int,
        lines: Sequence[tuple[int, int]],  # [begin, end) of ranges that cover each line once
        spent_s: Sequence[float],  # time of each range; if all are 0, nothing changes
    ) -> None:
        """Update the costs with the measured times of ranges of lines."""
        total_s = sum(spent_s)
        if not total_s > 0.0:
            return
        now, before = np.zeros(PARTS), self._parts[sensor]
        for (begin, end), part_s in zip(lines, spent_s, strict=True):
            expected = before * self._covered(sensor, begin, end)
            now += expected * (part_s / total_s / expected.sum())
        # Each part keeps a minimal cost, since its cost may grow when vehicles move.
        self._parts[sensor] = np.maximum(now, 1e-3 / PARTS) / np.maximum(now, 1e-3 / PARTS).sum()

    def _covered(self, sensor: int, begin: int, end: int) -> NDArray[np.float64]:
        """Return (PARTS,) the share of each part that lies in [begin, end)."""
        scale = PARTS / self._num_lines[sensor]
        edges = np.arange(PARTS, dtype=np.float64)
        low, high = np.clip([[begin * scale], [end * scale]], edges, edges + 1.0)
        covered: NDArray[np.float64] = high - low
        return covered
