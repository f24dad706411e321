"""Small sums over worlds that every tick needs.

NumPy needs a microsecond for each of them, but ten if the kernels of a tick have displaced its
large functions from the caches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel


@kernel
def begins_second(ticks: NDArray[np.int64], ticks_per_s: int) -> bool:
    """Return whether a second begins in any world with the present tick (W,)."""
    for tick in ticks:
        if tick % ticks_per_s == 0:
            return True
    return False


@kernel
def occasions(
    ticks: NDArray[np.int64],  # (W,) present ticks
    ticks_per_s: int,  # ticks in a second
    num_through: NDArray[np.int64],  # (k, W) vehicles that have arrived in each zone
) -> tuple[bool, bool]:
    """Return whether a second begins in any world, and whether a vehicle has arrived."""
    has_arrived = False
    for zone in range(num_through.shape[0]):
        for w in range(num_through.shape[1]):
            has_arrived |= num_through[zone, w] > 0
    return begins_second(ticks, ticks_per_s), has_arrived


@kernel
def count_tick(ticks: NDArray[np.int64]) -> None:
    """Increment the tick of all worlds (W,)."""
    for w in range(ticks.size):
        ticks[w] += 1


@kernel
def totals(counts: NDArray[np.int64], out: NDArray[np.int64]) -> None:
    """Add up `counts` (k, W) over the zones into `out` (W,)."""
    for w in range(out.size):
        total = 0
        for zone in range(counts.shape[0]):
            total += counts[zone, w]
        out[w] = total


@kernel
def any_positive(counts: NDArray[np.int64]) -> bool:
    """Return whether any of the counts (W,) is above 0."""
    for w in range(counts.size):
        if counts[w] > 0:
            return True
    return False


@kernel
def clear(counts: NDArray[np.int64]) -> None:
    """Set all counts (W,) to 0."""
    for w in range(counts.size):
        counts[w] = 0
