"""`LineCosts`: where in each sensor's frames the time goes, as its workers measure it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

PARTS = 32  # of a frame, in each of which lines are taken to cost the same


class LineCosts:
    """At first every line of a frame costs the same."""

    def __init__(self, num_lines: Sequence[int]) -> None:
        self._num_lines = tuple(num_lines)
        self._parts = np.full((len(num_lines), PARTS), 1.0 / PARTS)

    def part(self, sensor: int, begin: int, end: int) -> float:
        """What the lines [begin, end) cost, as a part of the frame."""
        return float(self._parts[sensor] @ self._covered(sensor, begin, end))

    def line_at(self, sensor: int, part: float) -> int:
        """The line before which about that part of the frame's cost lies."""
        before = np.concatenate([[0.0], np.cumsum(self._parts[sensor])])
        place = np.interp(part, before, np.arange(PARTS + 1.0))
        return round(float(place) / PARTS * self._num_lines[sensor])

    def learn(
        self,
        sensor: int,
        # [begin, end) of each part; together all lines, each once
        lines: Sequence[tuple[int, int]],
        spent_s: Sequence[float],  # of each; where all are 0 nothing is learnt
    ) -> None:
        """Correct it by the time that each part of a frame has taken."""
        total_s = sum(spent_s)
        if not total_s > 0.0:
            return
        now, before = np.zeros(PARTS), self._parts[sensor]
        for (begin, end), part_s in zip(lines, spent_s, strict=True):
            expected = before * self._covered(sensor, begin, end)
            now += expected * (part_s / total_s / expected.sum())
        # None is left without any: what costs nothing now may cost something when it moves.
        self._parts[sensor] = np.maximum(now, 1e-3 / PARTS) / np.maximum(now, 1e-3 / PARTS).sum()

    def _covered(self, sensor: int, begin: int, end: int) -> NDArray[np.float64]:
        """(PARTS,) how much of each part lies in some lines."""
        scale = PARTS / self._num_lines[sensor]
        edges = np.arange(PARTS, dtype=np.float64)
        low, high = np.clip([[begin * scale], [end * scale]], edges, edges + 1.0)
        covered: NDArray[np.float64] = high - low
        return covered
