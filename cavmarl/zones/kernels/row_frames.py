"""Frames that two processes exchange about the rows of a tick: ghosts and vehicles that leave.

If another process hosts a zone, the zone has no owned rows here, and `exchange` writes only its
ghosts. For a ghost that was in the previous frame, only words that differ from their forecast are
sent.
A ghost has V + S + 2 words: its row (VEHICLE), its step (PLAN), its `step_at`, its world.

A frame for a process with k zones in W worlds has these words:

    1           number of words in the frame
    W           numbers of vehicles that this process owns
    W           numbers of changes of route since the previous frame
    W           numbers of vehicles that leave
    k · W · 2   numbers of ghosts, and of ghosts that can touch a vehicle of the zone
    n           for each ghost, its index in the previous frame; -1: all its words are sent
    n           for each ghost, one bit per word: 1 if the word is sent, because it differs
    …           rows of the vehicles that leave
    …           words of ghosts
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.codes import COUNT_REROUTED
from cavmarl.zones.kernels.ghost_forecast import Forecast, is_known, write_forecast
from cavmarl.zones.kernels.row_bounds import is_bounded

ID = 0  # the word of a row with the vehicle's id
AFTER = 2  # number of words in a ghost after its row and its step
MOST = 64  # limit of the words of a ghost, since one word has one bit for each of them
GROUP = 8  # number of words that are compared at once
NO_FRAME = -(1 << 62)

Words = NDArray[np.int64]


class ExchangeState(NamedTuple):
    """The state that a process exchanges with another process."""

    rows: Words  # (2, k, W, C, V) rows of all zones
    steps: Words  # (k, W, C, S)
    step_at: NDArray[np.int64]  # (k, W, C)
    num_owned: NDArray[np.int64]  # (k, W)
    num_rows: NDArray[np.int64]  # (k, W)
    num_near: NDArray[np.int64]  # (k, W)
    mine: NDArray[np.int64]  # zones of this process
    theirs: NDArray[np.int64]  # zones of the other process
    running: NDArray[np.int64]  # (W,) output: vehicles of this process and of the frames read
    rerouted: NDArray[np.int64]  # (W,) output: changes of route up to the last frame


class Ghosts(NamedTuple):
    """Ghosts of a frame, (n, V + S + 2), as integers and as floats in the same memory."""

    words: Words
    floats: NDArray[np.float64]


class Passing(NamedTuple):
    """Vehicles that leave, in the arrays of the departure queue."""

    rows: Words  # (W, C + D, V)
    num: NDArray[np.int64]  # (W,)
    counts: NDArray[np.int64]  # (W, NUM_COUNTS)


@kernel
def count_own(
    num_owned: NDArray[np.int64], mine: NDArray[np.int64], running: NDArray[np.int64]
) -> None:
    """Write the number of vehicles (W,) that the zones of this process own."""
    for w in range(running.size):
        running[w] = 0
        for k in range(mine.size):
            running[w] += num_owned[mine[k], w]


@kernel
def pack_frame(
    both: ExchangeState,
    side: int,
    passing: Passing,
    forecast: Forecast,
    before: Ghosts,  # ghosts of the previous frame
    slots: NDArray[np.int32],  # scratch; its size is a power of two above the number of `before`
    now: Ghosts,  # output in the first rows: the ghosts
    frame: Words,  # output
) -> int:
    """Write a frame.

    Returns:
        The number n of ghosts; -1 - n if there is no room for them.
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
    frame[0] = at + _pack_ghosts(both, side, forecast, before, slots, now, frame, first, total, at)
    return int(total)


@inlined_kernel
def _pack_ghosts(
    both: ExchangeState,
    side: int,
    forecast: Forecast,
    before: Ghosts,
    slots: NDArray[np.int32],
    now: Ghosts,
    frame: Words,
    first: int,  # start in `frame` of the ghosts' indices in the previous frame
    total: int,
    at: int,  # start of the ghosts' words
) -> int:
    """Write the ghosts of a frame. Return the number of their words."""
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
                    _copy(before.words[found], 0, forecast.words, 0, ghost.size)
                    write_forecast(
                        forecast, before.floats[found], before.words[found],
                        now.floats[n], ghost, np.uint64(0), forecast.floats, forecast.words,
                    )  # fmt: skip
                    bits, at = _pack_differences(forecast.words, ghost, frame, at)
                frame[first + n] = found
                frame[first + total + n] = np.int64(bits)
                n += 1
    return at - begin


@inlined_kernel
def _every_bit(num: int) -> np.uint64:
    """Return a mask of the lowest `num` bits, at most 63."""
    return (np.uint64(1) << np.uint64(num)) - np.uint64(1)


@inlined_kernel
def _pack_differences(known: Words, ghost: Words, frame: Words, at: int) -> tuple[np.uint64, int]:
    """Write the words that differ from known words. Return their bits, and where they end."""
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
    """Return whether two rows differ in the words of a group."""
    differ = np.int64(0)
    if first + GROUP <= ghost.size:
        for c in range(GROUP):
            differ |= known[np.uint64(first + c)] ^ ghost[np.uint64(first + c)]
    else:
        for c in range(first, ghost.size):
            differ |= known[np.uint64(c)] ^ ghost[np.uint64(c)]
    return bool(differ != 0)


@inlined_kernel
def _count_ghosts(both: ExchangeState, frame: Words) -> int:
    """Return the number of ghosts in a frame; -1 if `pack_frame` has not made the frame.

    The caller must not read more of the frame if the result is -1, or if there is no room for the
    ghosts.
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
    both: ExchangeState,
    side: int,
    passing: Passing,  # output
    forecast: Forecast,
    before: Ghosts,  # ghosts of the previous frame
    now: Ghosts,  # output in the first rows: the ghosts
    frame: Words,
) -> int:
    """Append the rows in a frame to the rows of these zones and to the departure queue.

    Ghosts that can touch a vehicle come before all other ghosts.

    Returns:
        The number n of ghosts; -1 - n if there is no room for them; `NO_FRAME` if `pack_frame` has
        not made the frame. If the result is negative, no rows are appended.
    """
    total = _count_ghosts(both, frame)
    if total < 0:
        return NO_FRAME
    if total > now.words.shape[0]:
        return int(-1 - total)
    num_worlds = both.num_owned.shape[1]
    first = 1 + 3 * num_worlds
    before_at = first + both.mine.size * num_worlds * 2
    at = words = before_at + 2 * total
    row = passing.rows.shape[2]
    for w in range(num_worlds):
        leaving = frame[1 + 2 * num_worlds + w]
        if passing.num[w] + leaving > passing.rows.shape[1]:
            return NO_FRAME
        for _ in range(leaving):
            if not is_bounded(frame[words : words + row], forecast.row_bounds):
                return NO_FRAME
            words += row
    if not _unpack(forecast, before, now, total, frame, before_at, words):
        return NO_FRAME
    for n in range(total):
        if not is_bounded(now.words[n], forecast.bounds) or not _is_of_world(
            now.words[n], num_worlds
        ):
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
def _put(both: ExchangeState, side: int, zone: int, w: int, ghost: Words, is_near: bool) -> None:
    """Append a ghost to the rows of a zone."""
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
    # The indices are unsigned, because Numba checks whether signed indices are negative.
    for c in range(num):
        target[np.uint64(to + c)] = source[np.uint64(first + c)]


@inlined_kernel
def _unpack(
    forecast: Forecast,
    before: Ghosts,
    now: Ghosts,
    num: int,
    frame: Words,
    before_at: int,  # start in `frame` of the ghosts' indices in the previous frame
    at: int,  # start of the ghosts' words
) -> bool:
    """Write the ghosts of a frame to `now`. Return whether the frame is valid."""
    size = now.words.shape[1]
    for n in range(num):
        found = frame[before_at + n]
        bits = np.uint64(frame[before_at + num + n])
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
                    if is_known(bits, c):
                        if at == frame.size:
                            return False
                        ghost[c] = frame[at]
                        at += 1
        write_forecast(
            forecast, before.floats[found], before.words[found],
            now.floats[n], ghost, bits, now.floats[n], ghost,
        )  # fmt: skip
    return at == frame.size


@inlined_kernel
def _slot(ghost: Words, slots: NDArray[np.int32]) -> int:
    """Return the first slot for a ghost: a hash of its vehicle and its world."""
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
    """Return the index of the same vehicle's ghost in the previous frame; -1: there is none."""
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
