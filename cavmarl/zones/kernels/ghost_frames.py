"""Ghosts that go from process to process: packed by their owners, taken where they are seen.

`exchange` leaves the ghosts of a zone that another process hosts behind that zone's owned rows, of
which there are none in this one. Of a ghost that was in the frame before only the words that have
changed are sent. A ghost is V + S + 2 words: its row, its step, the lane of that, its world.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import inlined_kernel, kernel
from cavmarl.core.records.arrays import Zoned

ID = 0  # the word of a row that names the vehicle
AFTER = 2  # words of a ghost behind its row and its step
MOST = 64  # words of a ghost: one word has a bit for each that has changed

Words = NDArray[np.int64]


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
    rows: Words,  # (2, k, W, C, V) those of all zones
    steps: Words,  # (k, W, C, S)
    step_at: NDArray[np.int64],  # (k, W, C)
    side: int,
    zones: NDArray[np.int64],
    counts: NDArray[np.int64],  # as `count_ghosts` has written them
    before: Words,  # (p, V + S + 2) the ghosts of the frame before
    slots: NDArray[np.int32],  # scratch, a power of two and more than p
    now: Words,  # (n, V + S + 2) written: the ghosts
    like: NDArray[np.int64],  # (n,) written: where in `before` it was; -1: it is sent whole
    changed: NDArray[np.uint64],  # (n,) written: a bit for each word that has changed
    words: Words,  # written: those words
) -> int:
    """Pack the ghosts that `count_ghosts` has counted; how many words there are."""
    _fill_slots(before, slots)
    row = rows.shape[4]
    at = row + steps.shape[3]
    n = 0
    num = 0
    for k in range(zones.size):
        zone = zones[k]
        for w in range(counts.shape[1]):
            for i in range(counts[k, w, 0]):
                ghost = now[n]
                _copy(rows[side, zone, w, i], 0, ghost, 0, row)
                _copy(steps[zone, w, i], 0, ghost, row, at - row)
                ghost[at] = step_at[zone, w, i]
                ghost[at + 1] = w
                found = _find(before, slots, ghost)
                bits = np.uint64(0)
                for c in range(ghost.size):
                    if found < 0 or before[found, c] != ghost[c]:
                        bits |= np.uint64(1) << np.uint64(c)
                        words[num] = ghost[c]
                        num += 1
                like[n] = found
                changed[n] = bits
                n += 1
    return num


@kernel
def take_ghosts(
    zoned: Zoned,
    rows: Words,
    steps: Words,
    step_at: NDArray[np.int64],
    side: int,
    zones: NDArray[np.int64],
    counts: NDArray[np.int64],
    before: Words,  # (p, V + S + 2) the ghosts of the frame before
    now: Words,  # (n, V + S + 2) written: the ghosts
    like: NDArray[np.int64],
    changed: NDArray[np.uint64],
    words: Words,
) -> bool:
    """Put what another process has packed behind the rows of zones of this one.

    Ghosts that can touch a vehicle come before those that cannot.

    Returns:
        whether it is what `pack_ghosts` makes; else nothing is put anywhere.
    """
    if not _unpack(before, now, like, changed, words):
        return False
    row = rows.shape[4]
    at = row + steps.shape[3]
    n = 0
    for k in range(zones.size):
        zone = zones[k]
        for w in range(counts.shape[1]):
            for i in range(counts[k, w, 0]):
                place = zoned.num_rows[zone, w]
                if i < counts[k, w, 1]:
                    first_far = zoned.num_near[zone, w]
                    _copy(rows[side, zone, w, first_far], 0, rows[side, zone, w, place], 0, row)
                    _copy(steps[zone, w, first_far], 0, steps[zone, w, place], 0, at - row)
                    step_at[zone, w, place] = step_at[zone, w, first_far]
                    place = first_far
                    zoned.num_near[zone, w] += 1
                _copy(now[n], 0, rows[side, zone, w, place], 0, row)
                _copy(now[n], row, steps[zone, w, place], 0, at - row)
                step_at[zone, w, place] = now[n, at]
                zoned.num_rows[zone, w] += 1
                n += 1
    return True


@inlined_kernel
def _copy(source: Words, first: int, target: Words, to: int, num: int) -> None:
    for c in range(num):
        target[to + c] = source[first + c]


@inlined_kernel
def _unpack(
    before: Words, now: Words, like: NDArray[np.int64], changed: NDArray[np.uint64], words: Words
) -> bool:
    """Write the ghosts of a frame to `now`."""
    num = 0
    for n in range(now.shape[0]):
        found = like[n]
        if found >= before.shape[0]:
            return False
        bits = changed[n]
        for c in range(now.shape[1]):
            if bits >> np.uint64(c) & np.uint64(1):
                if num == words.size:
                    return False
                now[n, c] = words[num]
                num += 1
            elif found < 0:
                return False
            else:
                now[n, c] = before[found, c]
    return num == words.size


@inlined_kernel
def _slot(ghost: Words, slots: NDArray[np.int32]) -> int:
    """Where a ghost is looked for first, by its vehicle."""
    word = np.uint64(ghost[ID]) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(ghost[ghost.size - 1])
    return int(np.int64((word >> np.uint64(32)) & np.uint64(slots.size - 1)))


@inlined_kernel
def _fill_slots(before: Words, slots: NDArray[np.int32]) -> None:
    slots[:] = -1
    for n in range(before.shape[0]):
        at = _slot(before[n], slots)
        while slots[at] >= 0:
            at = (at + 1) & (slots.size - 1)
        slots[at] = n


@inlined_kernel
def _find(before: Words, slots: NDArray[np.int32], ghost: Words) -> int:
    """The ghost of the frame before of the same vehicle; -1: there was none."""
    at = _slot(ghost, slots)
    last = ghost.size - 1
    found = -1
    while slots[at] >= 0:
        n = slots[at]
        if before[n, ID] == ghost[ID] and before[n, last] == ghost[last]:
            found = n
            break
        at = (at + 1) & (slots.size - 1)
    return found
