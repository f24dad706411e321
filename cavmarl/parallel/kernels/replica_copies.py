"""Finds what has changed in one memory since another process saw it, and copies it there.

Both processes have the same arrays at the same places, as words of 8 bytes, and each keeps a copy
of what the other one knows of them. What is sent are the words that differ, as the bits in which
they do: so two processes may change different bytes of one word.

A stream is made of groups: the first word's number, a mask of the next 64 words, and of each word
in the mask its changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import inlined_kernel, kernel
from cavmarl.core.records.codes import DRIVER_AGENT

GROUP = 64  # words that share a mask
_WORD = 8  # bytes

Words = NDArray[np.uint64]


@inlined_kernel
def _note(memory: Words, known: Words, begin: int, end: int, out: Words, at: int) -> int:
    """Write groups of what has changed between two bytes behind out[:at]; where they end."""
    last = (end + _WORD - 1) // _WORD
    for first in range(begin // _WORD, last, GROUP):
        behind = min(first + GROUP, last)
        changed = np.uint64(0)
        for n in range(first, behind):
            changed |= memory[n] ^ known[n]
        if changed == np.uint64(0):
            continue
        mask = np.uint64(0)
        place = at + 2
        for n in range(first, behind):
            change = memory[n] ^ known[n]
            out[place] = change
            known[n] = memory[n]
            if change != np.uint64(0):
                mask |= np.uint64(1) << np.uint64(n - first)
                place += 1
        out[at] = np.uint64(first)
        out[at + 1] = mask
        at = place
    return at


@kernel
def note_spans(
    memory: Words,  # what there is
    known: Words,  # what the other process has; made the same
    spans: NDArray[np.int64],  # (n, 2) first byte and the one after the last
    out: Words,  # the stream, with a word to spare behind all changes
    at: int,  # its words so far
) -> int:  # its words now
    """Note what has changed between some bytes."""
    for n in range(spans.shape[0]):
        at = _note(memory, known, spans[n, 0], spans[n, 1], out, at)
    return at


@kernel
def note_rows(
    memory: Words,  # what there is
    known: Words,  # what the other process has; made the same
    first: int,  # byte of the first row of zone 0 in world 0
    # (3,) bytes from zone to zone, from world to world, from row to row
    strides: NDArray[np.int64],
    zones: NDArray[np.int64],
    counts: NDArray[np.int64],  # (k, W) rows to look at
    out: Words,  # as for `note_spans`
    at: int,  # as for `note_spans`
) -> int:
    """Note what has changed in the first rows of some zones; the stream's words afterwards."""
    for zone in zones:
        for w in range(counts.shape[1]):
            begin = first + zone * strides[0] + w * strides[1]
            end = begin + counts[zone, w] * strides[2]
            at = _note(memory, known, begin, end, out, at)
    return at


@kernel
def note_agents(
    memory: Words,  # what there is
    known: Words,  # what the other process has; made the same
    first: int,  # byte at which an array (W, A, …) begins
    size: int,  # bytes of each agent in it
    marks: NDArray[np.bool_],  # (W, A) which agents
    out: Words,  # as for `note_spans`
    at: int,  # as for `note_spans`
) -> int:
    """Note what has changed at the indices of some agents; the stream's words afterwards."""
    for w in range(marks.shape[0]):
        for agent in range(marks.shape[1]):
            if marks[w, agent]:
                begin = first + (w * marks.shape[1] + agent) * size
                at = _note(memory, known, begin, begin + size, out, at)
    return at


@kernel
def mark_agents(
    rows: NDArray[np.void],  # VEHICLE (k, W, C)
    num_owned: NDArray[np.int64],  # (k, W)
    zones: NDArray[np.int64],
    marks: NDArray[np.bool_],  # (W, A) is written
) -> None:
    """Find the agents whose vehicles some zones own."""
    marks[:] = False
    for zone in zones:
        for w in range(num_owned.shape[1]):
            for i in range(num_owned[zone, w]):
                row = rows[zone, w, i]
                if row["driver"] == DRIVER_AGENT:
                    marks[w, row["agent"]] = True


@kernel
def take_changes(
    stream: Words,  # what `note_spans` and the others have written
    first: int,  # where in it the groups of this memory begin
    last: int,  # and where they end
    memory: Words,  # is written
    known: Words,  # what the other process has; is written, too
) -> bool:  # whether they fit there; if not, some may have been written
    """Put changes of another process where they belong."""
    at = first
    size = memory.size
    while at < last:
        if at + 2 > last or stream[at] >= np.uint64(size):
            return False
        place = np.int64(stream[at])
        mask = stream[at + 1]
        at += 2
        while mask != np.uint64(0):
            if mask & np.uint64(1):
                if at >= last or place >= size:
                    return False
                memory[place] ^= stream[at]
                known[place] ^= stream[at]
                at += 1
            mask >>= np.uint64(1)
            place += 1
    return True
