"""Heights along roads as a graph of places: limits of the grade, and bridges."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Heights = NDArray[np.float64]
Rows = NDArray[np.int64]

_SHORTEST_M = 0.01  # minimum length of a link, because its ends may coincide
_TOLERANCE = 1e-8


@dataclass(frozen=True)
class ProfileGraph:
    """Places along lanes, and links along which vehicles drive from place to place."""

    places: int
    links: Rows  # (n, 2)
    lengths_m: Heights  # (n,)

    @cached_property
    def _neighbours(self) -> tuple[list[int], list[int], list[float]]:
        """First neighbour of each place, the neighbours, and their distances."""
        ends = np.concatenate([self.links, self.links[:, ::-1]])
        far = np.concatenate([self.lengths_m, self.lengths_m])
        order = np.argsort(ends[:, 0], kind="stable")
        first = np.searchsorted(ends[order, 0], np.arange(self.places + 1))
        return first.tolist(), ends[order, 1].tolist(), far[order].tolist()

    def capped(self, heights: Heights, caps: Heights, grade: float) -> Heights:
        """Return the highest profile below `heights` that rises from caps by at most `grade`.

        `caps`: (places,) maximum heights in m; infinite: none.
        """
        first, neighbours, far = self._neighbours
        result, own = caps.tolist(), heights.tolist()
        heap = [(float(caps[row]), int(row)) for row in np.flatnonzero(np.isfinite(caps))]
        heapq.heapify(heap)
        while heap:
            height, row = heapq.heappop(heap)
            if height > result[row]:
                continue
            for link in range(first[row], first[row + 1]):
                beside = neighbours[link]
                reached = height + grade * far[link]
                # The slope from a cap ends where it meets `heights`.
                if reached < result[beside] and reached < own[beside]:
                    result[beside] = reached
                    heapq.heappush(heap, (reached, beside))
        lowered: Heights = np.minimum(np.array(result), heights)
        return lowered

    def lifted(self, heights: Heights, floors: Heights, grade: float) -> Heights:
        """Return the lowest profile above `heights` that falls from floors by at most `grade`."""
        return -self.capped(-heights, -floors, grade)

    def limited(self, heights: Heights, grade: float) -> Heights:
        """Return the profile with the least maximum change that has no link above `grade`."""
        return (self.capped(heights, heights, grade) + self.lifted(heights, heights, grade)) / 2.0

    def spanned(self, heights: Heights, free: NDArray[np.bool_]) -> Heights:
        """Return heights with `free` places on straight lines between places that are not free.

        Solved by conjugate gradients; free parts without an abutment do not change.
        """
        touched = free[self.links].any(axis=1)
        rows, numbers = np.unique(self.links[touched], return_inverse=True)
        links: Rows = numbers.reshape(-1, 2)
        result = heights.copy()
        result[rows] = _straight(heights[rows], free[rows], links, self.lengths_m[touched])
        return result


def _straight(
    heights: Heights, free: NDArray[np.bool_], links: Rows, lengths_m: Heights
) -> Heights:
    weights = 1.0 / np.maximum(lengths_m, _SHORTEST_M)
    one, other = links.T

    def pull(values: Heights) -> Heights:
        flow = weights * (values[one] - values[other])
        total = np.bincount(one, flow, len(values)) - np.bincount(other, flow, len(values))
        return np.where(free, total, 0.0)

    diagonal = np.bincount(one, weights, len(free)) + np.bincount(other, weights, len(free))
    scale = np.where(free, 1.0 / np.maximum(diagonal, 1e-12), 0.0)
    result = heights.copy()
    rest = -pull(result)
    direction = scale * rest
    power = float((rest * direction).sum())
    for _ in range(4 * int(free.sum()) + 10):
        if power < _TOLERANCE:
            break
        pulled = pull(direction)
        step = power / float((direction * pulled).sum())
        result += step * direction
        rest -= step * pulled
        fresh = scale * rest
        power, before = float((rest * fresh).sum()), power
        direction = fresh + power / before * direction
    return result
