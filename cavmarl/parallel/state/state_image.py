"""`Image`: arrays in a segment, with a checksum, from which another process can resume."""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Sequence
from operator import is_
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64_intdigest

from cavmarl.core.errors import WorkerError
from cavmarl.parallel.memory.shared_memory import Segment

Array = NDArray[Any]
Arrays = Sequence[Array]

_WORD = 8
_HEAD = 3  # words: number of all words, checksum, number of arrays


class _Place(NamedTuple):
    """The place of an array in an image."""

    shape: tuple[int, ...]
    end: int  # offset in words from the start of the image
    target: Array  # the place as an array of raw items


class Image:
    """Arrays as they were at one moment, in a segment."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._memory: mmap.mmap | None = None
        self._words = np.zeros(0, dtype=np.int64)
        self._begin = 0  # word at which the first array starts
        self._places: list[_Place] = []
        self._written: Arrays = ()  # arrays of the last `write`
        self._copies: list[tuple[Array, Array]] = []  # (target, source) of each copy

    def write(self, arrays: Arrays) -> None:
        """Copy arrays into the image; dtypes must not change from call to call.

        Raises:
            OSError: there is not enough memory.
        """
        if len(arrays) != len(self._written) or not all(map(is_, arrays, self._written)):
            self._find_places(arrays)
        for target, source in self._copies:
            target[...] = source
        self._words[1] = _checksum(self._words[2 : self._words.item(0)])

    def _find_places(self, arrays: Arrays) -> None:
        shapes = [array.shape for array in arrays]
        same = _num_same(shapes, self._places)
        if len(arrays) != len(self._places):
            self._lay_out(arrays, 0)
        elif same < len(arrays):
            self._lay_out(arrays, same)
        self._written = tuple(arrays)
        self._copies = [
            (place.target, array.view(place.target.dtype))
            for array, place in zip(arrays, self._places, strict=True)
        ]

    def _lay_out(self, arrays: Arrays, same: int) -> None:
        """Find the place of each array; the first `same` arrays keep their places.

        Callers pass arrays of constant shapes before arrays whose shapes vary.
        """
        head = [array.ndim for array in arrays]
        for array in arrays:
            head.extend(array.shape)
        begin = _HEAD + len(head)
        size = begin + sum(map(_num_words, arrays))
        if self._make_room(_WORD * size) or begin != self._begin:
            same = 0
        self._begin = begin
        words = self._words
        words[0], words[2] = size, len(arrays)
        words[_HEAD:begin] = head
        del self._places[same:]
        at = self._places[-1].end if same else begin
        for array in arrays[same:]:
            end = at + _num_words(array)
            if array.nbytes:
                words[end - 1] = 0  # padding
            raw = np.dtype((np.void, array.itemsize))  # NumPy copies records field by field
            place = words[at:end].view(np.uint8)[: array.nbytes]
            target = place.view(raw).reshape(array.shape)
            self._places.append(_Place(array.shape, end, target))
            at = end

    def read(self, dtypes: Sequence[np.dtype[Any]]) -> Iterator[Array]:
        """Yield the arrays in their order, as views.

        Raises:
            WorkerError: the image is damaged.
        """
        self._map_all()
        words = self._words
        size = int(words[0]) if len(words) else 0
        if not _HEAD <= size <= len(words) or words[1] != _checksum(words[2:size]):
            raise WorkerError("the state of a worker in shared memory is damaged")
        ranks = words[_HEAD : _HEAD + len(dtypes)].tolist()
        shape_at = _HEAD + len(ranks)
        at = shape_at + sum(ranks)
        for dtype, rank in zip(dtypes, ranks, strict=True):
            shape = words[shape_at : shape_at + rank].tolist()
            shape_at += rank
            num_bytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
            end = at + -(-num_bytes // _WORD)
            yield words[at:end].view(np.uint8)[:num_bytes].view(dtype).reshape(shape)
            at = end

    def _make_room(self, size: int) -> bool:
        """Grow to this number of bytes; return whether the mapping of the image has changed."""
        if size <= _WORD * len(self._words):
            return False
        self._segment.grow(-(-size * 5 // 4 // mmap.PAGESIZE) * mmap.PAGESIZE)
        self._map_all()
        return True

    def _map_all(self) -> None:
        """Map the segment at its current size, which another process may have changed."""
        self._memory = self._segment.map()
        self._words = np.frombuffer(self._memory, dtype=np.int64)


def _num_words(array: Array) -> int:
    return -(-array.nbytes // _WORD)


def _num_same(shapes: Sequence[tuple[int, ...]], places: Sequence[_Place]) -> int:
    """Return how many of the first arrays have the same shapes as before."""
    for n, (shape, place) in enumerate(zip(shapes, places, strict=False)):
        if shape != place.shape:
            return n
    return min(len(shapes), len(places))


def _checksum(words: NDArray[np.int64]) -> int:
    """Return XXH3 of 64 bits, as a signed word."""
    found = xxh3_64_intdigest(words.data)
    return found - (found >> 63 << 64)
