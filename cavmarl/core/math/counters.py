"""Small sums over worlds that every tick asks for.

NumPy does each of them in a microsecond, but in ten where the kernels of a tick have emptied the
caches: its functions are large.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel


@kernel
def begins_second(ticks: NDArray[np.int64], ticks_per_s: int) -> bool:
    """Whether a second begins in some world with the present tick (W,)."""
    for tick in ticks:
        if tick % ticks_per_s == 0:
            return True
    return False


@kernel
def occasions(
    ticks: NDArray[np.int64],  # (W,) the present tick
    ticks_per_s: int,  # in a second
    num_through: NDArray[np.int64],  # (k, W) vehicles that have arrived in each zone
) -> tuple[bool, bool]:
    """Whether a second begins in some world, and whether a vehicle has arrived."""
    has_arrived = False
    for zone in range(num_through.shape[0]):
        for w in range(num_through.shape[1]):
            has_arrived |= num_through[zone, w] > 0
    return begins_second(ticks, ticks_per_s), has_arrived


@kernel
def count_tick(ticks: NDArray[np.int64]) -> None:
    """One more tick in all worlds (W,)."""
    for w in range(ticks.size):
        ticks[w] += 1


@kernel
def totals(counts: NDArray[np.int64], out: NDArray[np.int64]) -> None:
    """Add up (k, W) over zones into `out` (W,)."""
    for w in range(out.size):
        total = 0
        for zone in range(counts.shape[0]):
            total += counts[zone, w]
        out[w] = total


@kernel
def any_positive(counts: NDArray[np.int64]) -> bool:
    """Return whether one of the counts (W,) is above 0."""
    for w in range(counts.size):
        if counts[w] > 0:
            return True
    return False


@kernel
def clear(counts: NDArray[np.int64]) -> None:
    """Set all counts (W,) to 0."""
    for w in range(counts.size):
        counts[w] = 0
