"""Ghosts that go from process to process: packed by their owners, taken where they are seen.

`exchange` leaves the ghosts of a zone that another process hosts behind that zone's owned rows, of
which there are none in this one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Zoned


@kernel
def count_ghosts(zoned: Zoned, zones: NDArray[np.int64], counts: NDArray[np.int64]) -> int:
    """How many ghosts zones of another process get of this one; how many in all.

    `zones`: (k,) which. `counts`: (k, W, 2) written: ghosts, and those of them that can touch a
    vehicle there.
    """
    total = 0
    for k in range(zones.size):
        for w in range(counts.shape[1]):
            counts[k, w, 0] = zoned.num_rows[zones[k], w]
            counts[k, w, 1] = zoned.num_near[zones[k], w]
            total += counts[k, w, 0]
    return total


@kernel
def pack_ghosts(
    zoned: Zoned,
    side: int,
    zones: NDArray[np.int64],
    counts: NDArray[np.int64],
    rows: NDArray[np.void],
    step: NDArray[np.void],
    step_at: NDArray[np.int64],
) -> None:
    """Copy the ghosts that `count_ghosts` has counted to `rows` (n,), `step` and `step_at`."""
    n = 0
    for k in range(zones.size):
        for w in range(counts.shape[1]):
            for i in range(counts[k, w, 0]):
                rows[n] = zoned.rows[side, zones[k], w, i]
                step[n] = zoned.step[zones[k], w, i]
                step_at[n] = zoned.step_at[zones[k], w, i]
                n += 1


@kernel
def take_ghosts(
    zoned: Zoned,
    side: int,
    zones: NDArray[np.int64],
    counts: NDArray[np.int64],
    rows: NDArray[np.void],
    step: NDArray[np.void],
    step_at: NDArray[np.int64],
) -> None:
    """Put what another process has packed behind the rows of zones of this one.

    Ghosts that can touch a vehicle come before those that cannot.
    """
    n = 0
    for k in range(zones.size):
        zone = zones[k]
        for w in range(counts.shape[1]):
            own = zoned.rows[side, zone, w]
            for i in range(counts[k, w, 0]):
                place = zoned.num_rows[zone, w]
                if i < counts[k, w, 1]:
                    first_far = zoned.num_near[zone, w]
                    own[place] = own[first_far]
                    zoned.step[zone, w, place] = zoned.step[zone, w, first_far]
                    zoned.step_at[zone, w, place] = zoned.step_at[zone, w, first_far]
                    place = first_far
                    zoned.num_near[zone, w] += 1
                own[place] = rows[n]
                zoned.step[zone, w, place] = step[n]
                zoned.step_at[zone, w, place] = step_at[n]
                zoned.num_rows[zone, w] += 1
                n += 1
