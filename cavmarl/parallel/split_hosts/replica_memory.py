"""`ReplicaMemory`: arrays at the same places in processes on different machines.

Each process makes the same arrays in the same order. A `MemoryReplica` stands for one process at
the
other end: what it knows of this memory, what is to be sent, and what has come (`kernels.replicas`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cavmarl.core.errors import MessageError
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.numba.specialized import specialized
from cavmarl.parallel.kernels.replica_copies import (
    GROUP,
    note_agents,
    note_rows,
    note_spans,
    take_changes,
)

Array = NDArray[Any]
Words = NDArray[np.uint64]

ARENA = 1 << 16  # bytes that small arrays share
_LINE = 64  # bytes of a cache line: no two arrays share one
_WORD = 8


class Place(NamedTuple):
    arena: int  # in which part of the memory
    first: int  # byte of it


Spans = Sequence[tuple[int, NDArray[np.int64]]]
"""Part of the memory, (n, 2) first byte and the one after the last."""


class ReplicaMemory:
    """The arrays of one process."""

    def __init__(self) -> None:
        self.arenas: list[Words] = []  # (n,) words each; what arrays lie in
        self._starts: list[int] = []
        self._used = ARENA  # bytes of the arena that small arrays share
        self._shared = -1  # its number

    def zeros(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> Array:
        """As `numpy.zeros`, at the next place."""
        kind = np.dtype(dtype)
        sides = (shape,) if isinstance(shape, int) else tuple(shape)
        size = prod(sides) * kind.itemsize
        room = max(_LINE, -(-size // _LINE) * _LINE)
        if room >= ARENA:
            arena, first = self._add(room), 0
        else:
            if self._used + room > ARENA:
                self._shared, self._used = self._add(ARENA), 0
            arena, first = self._shared, self._used
            self._used += room
        taken = self.arenas[arena].view(np.uint8)[first : first + size]
        return taken.view(kind).reshape(sides)

    def _add(self, size: int) -> int:
        arena = huge_zeros(size // _WORD, dtype=np.uint64)
        self.arenas.append(arena)
        self._starts.append(_address(arena))
        return len(self.arenas) - 1

    def find(self, array: Array) -> Place | None:
        """Where an array lies; None: somewhere else."""
        at = _address(array)
        for number, (start, arena) in enumerate(zip(self._starts, self.arenas, strict=True)):
            if start <= at and at + array.nbytes <= start + arena.nbytes:
                return Place(number, at - start)
        return None

    def place_of(self, array: Array) -> Place:
        place = self.find(array)
        if place is None:
            raise ValueError(f"an array {array.shape} of {array.dtype} is no part of this memory")
        return place

    def spans_of(self, arrays: Iterable[Array]) -> Spans:
        """Where some arrays lie, all of each."""
        found: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        for array in arrays:
            if array.nbytes:
                place = self.place_of(array)
                found[place.arena].append((place.first, place.first + array.nbytes))
        return [(arena, np.array(_joined(spans))) for arena, spans in sorted(found.items())]

    @property
    def most_words(self) -> int:
        """Of a stream in which everything has changed, but for the heads of small pieces."""
        words = sum(arena.size for arena in self.arenas)
        return words + 2 * (words // GROUP + 1)


def _joined(spans: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """The same with those joined that lie next to each other."""
    found: list[tuple[int, int]] = []
    for first, last in sorted(spans):
        if found and first - found[-1][1] < _LINE:
            found[-1] = found[-1][0], last
        else:
            found.append((first, last))
    return found


def _address(array: Array) -> int:
    return int(array.__array_interface__["data"][0])


class MemoryReplica:
    """What one other process knows of a memory."""

    def __init__(
        self,
        memory: ReplicaMemory,  # whose arrays are all made
        pieces: int,  # how many there can be at most in a stream that are not next to each other
    ) -> None:
        self._memory = memory
        self._stream: Words = np.empty(memory.most_words + 6 * pieces + 1, dtype=np.uint64)
        self._size = 0
        self._note_spans = specialized(note_spans)
        self._note_rows = specialized(note_rows)
        self._note_agents = specialized(note_agents)
        self._take_changes = specialized(take_changes)
        self.forget()

    def forget(self) -> None:
        """The other process is a new one: all that it has is 0."""
        self._known: list[Words] = [
            np.zeros(arena.size, dtype=np.uint64) for arena in self._memory.arenas
        ]

    def begin(self) -> None:
        self._size = 0

    @property
    def stream(self) -> Words:
        """What there is to send; a view that the next stream overwrites."""
        return self._stream[: self._size]

    def note(self, spans: Spans) -> None:
        for arena, bounds in spans:
            self._write(arena, self._note_spans, bounds)

    def note_rows(
        self,
        place: Place,
        strides: NDArray[np.int64],
        zones: NDArray[np.int64],
        counts: NDArray[np.int64],
    ) -> None:
        """Note what has changed in the first rows of zones; see `kernels.replicas.note_rows`."""
        self._write(place.arena, self._note_rows, place.first, strides, zones, counts)

    def note_agents(self, place: Place, size: int, marks: NDArray[np.bool_]) -> None:
        """Note what has changed of some agents; see `kernels.replicas.note_agents`."""
        self._write(place.arena, self._note_agents, place.first, size, marks)

    def take(self, stream: Words) -> None:
        """Make the changes that the other process has sent."""
        at = 0
        while at < stream.size:
            arena, end = (stream.item(at), stream.item(at + 1)) if at + 2 <= stream.size else (0, 0)
            fits = at + 2 < end <= stream.size and arena < len(self._known)
            if not fits or not self._take_changes(
                stream, at + 2, end, self._memory.arenas[arena], self._known[arena]
            ):
                raise MessageError("changes of a memory that is not like this one")
            at = end

    def _write(self, arena: int, note: Callable[..., int], *what: Any) -> None:
        """Let a kernel write the changes of one part of the memory; without groups it was none."""
        memory, known, first = self._memory.arenas[arena], self._known[arena], self._size + 2
        at = note(memory, known, *what, self._stream, first)
        if at > first:
            self._stream[self._size] = arena
            self._stream[self._size + 1] = at
            self._size = at
