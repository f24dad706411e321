"""What each process tells another one about the rows of a tick: ghosts, and vehicles that leave.

`exchange` leaves the ghosts of a zone that another process hosts behind that zone's owned rows, of
which there are none in this one. Of a ghost that was in the frame before only the words that have
changed are sent. A ghost is V + S + 2 words: its row, its step, the lane of that, its world.

A frame is words, of W worlds and k zones of the process that it goes to:

    1           words of the frame
    W           vehicles that this process owns
    W           of these that have taken another way since the frame before
    W           vehicles that leave
    k · W · 2   ghosts; those of them that can touch a vehicle there
    n           of each ghost where it was in the frame before; -1: it is sent whole
    n           of each ghost a bit for each word that is sent: it is not as `ghost_forecast` says
    …           rows of the vehicles that leave
    …           words of ghosts
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.codes import COUNT_REROUTED
from cavmarl.zones.kernels.ghost_forecast import Forecast, foresee, is_told
from cavmarl.zones.kernels.row_bounds import is_bounded

ID = 0  # the word of a row that names the vehicle
AFTER = 2  # words of a ghost behind its row and its step
MOST = 64  # words of a ghost: one word has a bit for each that is sent
GROUP = 8  # words that are compared at once
NO_FRAME = -(1 << 62)

Words = NDArray[np.int64]


class Both(NamedTuple):
    """What two processes tell each other about, seen from one of them."""

    rows: Words  # (2, k, W, C, V) those of all zones
    steps: Words  # (k, W, C, S)
    step_at: NDArray[np.int64]  # (k, W, C)
    num_owned: NDArray[np.int64]  # (k, W)
    num_rows: NDArray[np.int64]  # (k, W)
    num_near: NDArray[np.int64]  # (k, W)
    mine: NDArray[np.int64]  # zones of this process
    theirs: NDArray[np.int64]  # and of the other one
    running: NDArray[np.int64]  # (W,) written: vehicles of this process, and of others as they come
    rerouted: NDArray[np.int64]  # (W,) written: those that had taken another way by the last frame


class Ghosts(NamedTuple):
    """Ghosts of a frame, (n, V + S + 2), as whole numbers and as floats: the same memory."""

    words: Words
    floats: NDArray[np.float64]


class Passing(NamedTuple):
    """What leaves, as the departure queue has it."""

    rows: Words  # (W, C + D, V)
    num: NDArray[np.int64]  # (W,)
    counts: NDArray[np.int64]  # (W, NUM_COUNTS)


@kernel
def count_own(
    num_owned: NDArray[np.int64], mine: NDArray[np.int64], running: NDArray[np.int64]
) -> None:
    """Write how many vehicles zones own, (W,)."""
    for w in range(running.size):
        running[w] = 0
        for k in range(mine.size):
            running[w] += num_owned[mine[k], w]


@kernel
def pack_frame(
    both: Both,
    side: int,
    passing: Passing,
    law: Forecast,
    before: Ghosts,  # those of the frame before
    slots: NDArray[np.int32],  # scratch, a power of two and more than these
    now: Ghosts,  # written: the ghosts, first of all
    frame: Words,  # written
) -> int:
    """Write a frame.

    Returns:
        how many ghosts it has; if there is no room for them, -1 less that number.
    """
    num_worlds = both.num_owned.shape[1]
    first = 1 + 3 * num_worlds
    total = 0
    leaving = 0
    count_own(both.num_owned, both.mine, both.running)
    for w in range(num_worlds):
        frame[1 + w] = both.running[w]
        frame[1 + num_worlds + w] = passing.counts[w, COUNT_REROUTED] - both.rerouted[w]
        frame[1 + 2 * num_worlds + w] = passing.num[w]
        leaving += passing.num[w]
    for k in range(both.theirs.size):
        for w in range(num_worlds):
            frame[first] = both.num_rows[both.theirs[k], w]
            frame[first + 1] = both.num_near[both.theirs[k], w]
            total += frame[first]
            first += 2
    row = passing.rows.shape[2]
    most = first + total * (2 + now.words.shape[1]) + leaving * row
    if total > now.words.shape[0] or most > frame.size:
        return -1 - total
    at = first + 2 * total
    for w in range(num_worlds):
        for i in range(passing.num[w]):
            _copy(passing.rows[w, i], 0, frame, at, row)
            at += row
    frame[0] = at + _pack_ghosts(both, side, law, before, slots, now, frame, first, total, at)
    return int(total)


@inlined_kernel
def _pack_ghosts(
    both: Both,
    side: int,
    law: Forecast,
    before: Ghosts,
    slots: NDArray[np.int32],
    now: Ghosts,
    frame: Words,
    first: int,  # where `like` begins
    total: int,
    at: int,  # where their words begin
) -> int:
    """Write the ghosts of a frame; how many words they take."""
    _fill_slots(before.words, slots)
    row = both.rows.shape[4]
    last = row + both.steps.shape[3]
    begin = at
    n = 0
    for k in range(both.theirs.size):
        zone = both.theirs[k]
        for w in range(both.num_owned.shape[1]):
            for i in range(both.num_rows[zone, w]):
                ghost = now.words[n]
                _copy(both.rows[side, zone, w, i], 0, ghost, 0, row)
                _copy(both.steps[zone, w, i], 0, ghost, row, last - row)
                ghost[last] = both.step_at[zone, w, i]
                ghost[last + 1] = w
                found = _find(before.words, slots, ghost)
                bits = _every_bit(ghost.size)
                if found < 0:
                    _copy(ghost, 0, frame, at, ghost.size)
                    at += ghost.size
                else:
                    _copy(before.words[found], 0, law.words, 0, ghost.size)
                    foresee(
                        law, before.floats[found], before.words[found],
                        now.floats[n], ghost, np.uint64(0), law.floats, law.words,
                    )  # fmt: skip
                    bits, at = _pack_differences(law.words, ghost, frame, at)
                frame[first + n] = found
                frame[first + total + n] = np.int64(bits)
                n += 1
    return at - begin


@inlined_kernel
def _every_bit(num: int) -> np.uint64:
    """The first bits, so many, at most 63."""
    return (np.uint64(1) << np.uint64(num)) - np.uint64(1)


@inlined_kernel
def _pack_differences(known: Words, ghost: Words, frame: Words, at: int) -> tuple[np.uint64, int]:
    """Write the words that are not as they are known; their bits, and where they end."""
    bits = np.uint64(0)
    for first in range(0, ghost.size, GROUP):
        if _differ(known, ghost, first):
            for c in range(first, min(first + GROUP, ghost.size)):
                word = ghost[np.uint64(c)]
                if known[np.uint64(c)] != word:
                    bits |= np.uint64(1) << np.uint64(c)
                    frame[np.uint64(at)] = word
                    at += 1
    return bits, at


@inlined_kernel
def _differ(known: Words, ghost: Words, first: int) -> bool:
    """Whether two rows are different in the words of a group."""
    differ = np.int64(0)
    if first + GROUP <= ghost.size:
        for c in range(GROUP):
            differ |= known[np.uint64(first + c)] ^ ghost[np.uint64(first + c)]
    else:
        for c in range(first, ghost.size):
            differ |= known[np.uint64(c)] ^ ghost[np.uint64(c)]
    return bool(differ != 0)


@inlined_kernel
def _count_ghosts(both: Both, frame: Words) -> int:
    """How many ghosts a frame says that it has; -1: it is none that `pack_frame` makes.

    Nothing else of a frame may be read if it is -1, nor if there is no room for what it has.
    """
    num_worlds = both.num_owned.shape[1]
    first = 1 + 3 * num_worlds
    if first + both.mine.size * num_worlds * 2 > frame.size or frame[0] != frame.size:
        return -1
    total = 0
    leaving = 0
    for w in range(num_worlds):
        num = frame[1 + 2 * num_worlds + w]
        if num < 0 or num > frame.size or frame[1 + w] < 0:
            return -1
        leaving += num
    for k in range(both.mine.size):
        for w in range(num_worlds):
            num = frame[first]
            room = both.step_at.shape[2] - both.num_rows[both.mine[k], w]
            if num < 0 or num > room or frame[first + 1] < 0 or frame[first + 1] > num:
                return -1
            total += num
            first += 2
    if first + 2 * total + leaving * both.rows.shape[4] > frame.size:
        return -1
    return total


@kernel
def take_frame(
    both: Both,
    side: int,
    passing: Passing,  # written
    law: Forecast,
    before: Ghosts,  # those of the frame before
    now: Ghosts,  # written: the ghosts, first of all
    frame: Words,
) -> int:
    """Append rows that another process packed to the rows of these zones and the departure queue.

    Ghosts that can touch a vehicle come before those that cannot.

    Returns:
        how many ghosts it has; if there is no room for them, -1 less that number; `NO_FRAME`: it is
        none that `pack_frame` makes. Below 0 nothing is put anywhere.
    """
    total = _count_ghosts(both, frame)
    if total < 0:
        return NO_FRAME
    if total > now.words.shape[0]:
        return int(-1 - total)
    num_worlds = both.num_owned.shape[1]
    first = 1 + 3 * num_worlds
    like = first + both.mine.size * num_worlds * 2
    at = words = like + 2 * total
    row = passing.rows.shape[2]
    for w in range(num_worlds):
        leaving = frame[1 + 2 * num_worlds + w]
        if passing.num[w] + leaving > passing.rows.shape[1]:
            return NO_FRAME
        for _ in range(leaving):
            if not is_bounded(frame[words : words + row], law.row_bounds):
                return NO_FRAME
            words += row
    if not _unpack(law, before, now, total, frame, like, words):
        return NO_FRAME
    for n in range(total):
        if not is_bounded(now.words[n], law.bounds) or not _is_of_world(now.words[n], num_worlds):
            return NO_FRAME
    for w in range(num_worlds):
        both.running[w] += frame[1 + w]
        passing.counts[w, COUNT_REROUTED] += frame[1 + num_worlds + w]
        both.rerouted[w] = passing.counts[w, COUNT_REROUTED]
        for _ in range(frame[1 + 2 * num_worlds + w]):
            _copy(frame, at, passing.rows[w, passing.num[w]], 0, row)
            passing.num[w] += 1
            at += row
    n = 0
    for k in range(both.mine.size):
        for w in range(num_worlds):
            for i in range(frame[first]):
                _put(both, side, both.mine[k], w, now.words[n], i < frame[first + 1])
                n += 1
            first += 2
    return int(total)


@inlined_kernel
def _is_of_world(ghost: Words, num_worlds: int) -> bool:
    return bool(0 <= ghost[ghost.size - 1] < num_worlds)


@inlined_kernel
def _put(both: Both, side: int, zone: int, w: int, ghost: Words, is_near: bool) -> None:
    """Put a ghost behind the rows of a zone."""
    rows = both.rows[side, zone, w]
    steps = both.steps[zone, w]
    step_at = both.step_at[zone, w]
    row = rows.shape[1]
    at = row + steps.shape[1]
    place = both.num_rows[zone, w]
    if is_near:
        first_far = both.num_near[zone, w]
        _copy(rows[first_far], 0, rows[place], 0, row)
        _copy(steps[first_far], 0, steps[place], 0, at - row)
        step_at[place] = step_at[first_far]
        place = first_far
        both.num_near[zone, w] += 1
    _copy(ghost, 0, rows[place], 0, row)
    _copy(ghost, row, steps[place], 0, at - row)
    step_at[place] = ghost[at]
    both.num_rows[zone, w] += 1


@inlined_kernel
def _copy(source: Words, first: int, target: Words, to: int, num: int) -> None:
    # Unsigned: Numba asks of each other number whether it is below 0.
    for c in range(num):
        target[np.uint64(to + c)] = source[np.uint64(first + c)]


@inlined_kernel
def _unpack(
    law: Forecast,
    before: Ghosts,
    now: Ghosts,
    num: int,
    frame: Words,
    like: int,  # where `like` begins
    at: int,  # where the ghosts' words begin
) -> bool:
    """Write the ghosts of a frame to `now`; whether they are of one."""
    size = now.words.shape[1]
    for n in range(num):
        found = frame[like + n]
        bits = np.uint64(frame[like + num + n])
        if found >= before.words.shape[0] or bits > _every_bit(size):
            return False
        ghost = now.words[n]
        if found < 0:
            if bits != _every_bit(size) or at + size > frame.size:
                return False
            _copy(frame, at, ghost, 0, size)
            at += size
            continue
        _copy(before.words[found], 0, ghost, 0, size)
        for first in range(0, size, GROUP):
            if bits >> np.uint64(first) & _every_bit(GROUP):
                for c in range(first, min(first + GROUP, size)):
                    if is_told(bits, c):
                        if at == frame.size:
                            return False
                        ghost[c] = frame[at]
                        at += 1
        foresee(
            law, before.floats[found], before.words[found],
            now.floats[n], ghost, bits, now.floats[n], ghost,
        )  # fmt: skip
    return at == frame.size


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
