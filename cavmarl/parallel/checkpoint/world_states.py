"""Worlds that one host leaves for another, as bytes, and what the caller says of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.processes.state_image import Image

Array = NDArray[Any]
Bytes = NDArray[np.uint8]


class WorldMove(NamedTuple):
    """What becomes of the worlds of one host, which follow each other before and after."""

    first: int  # of those that it keeps, as it has counted up to now
    last: int  # the one after the last that it keeps
    before: int = 0  # how many come that stand before those
    coming: int = 0  # how many come
    bytes: int = 0  # of those that come


def moves_of(
    before: Sequence[int],  # (m + 1,) the first world of each host, and the end of the last one's
    after: Sequence[int],  # the same, when all have moved
) -> list[WorldMove]:
    """What each host keeps, and how many worlds come to it."""
    moves = []
    for k in range(len(before) - 1):
        own, wanted = range(*before[k : k + 2]), range(*after[k : k + 2])
        first, last = max(own.start, wanted.start), min(own.stop, wanted.stop)
        if first >= last:  # it keeps none; all that come stand before nothing
            moves.append(WorldMove(0, 0, len(wanted), len(wanted)))
        else:
            coming = len(wanted) - (last - first)
            moves.append(
                WorldMove(first - own.start, last - own.start, first - wanted.start, coming)
            )
    return moves


def buffers(count: int, size: int) -> tuple[NDArray[np.int64], Bytes]:
    """Room for some packed worlds: the bytes of each, and all of them one behind the other."""
    return np.empty(count, dtype=np.int64), np.empty(size, dtype=np.uint8)


def pack(image: Image, worlds: Sequence[Sequence[Array]]) -> tuple[NDArray[np.int64], Bytes]:
    """Some worlds as bytes, as `buffers` has room for."""
    packed = []
    for arrays in worlds:
        image.write(arrays)
        packed.append(image.content().copy())
    sizes = np.array([one.size for one in packed], dtype=np.int64)
    return sizes, np.concatenate([np.empty(0, dtype=np.uint8), *packed])


def unpack(
    image: Image, sizes: NDArray[np.int64], content: Bytes, dtypes: Sequence[np.dtype[Any]]
) -> list[list[Array]]:
    """The arrays of each of some worlds. Raises WorkerError: they are not what was packed."""
    worlds = []
    for one in np.split(content, np.cumsum(sizes)[:-1]) if sizes.size else []:
        image.put(one)
        worlds.append([array.copy() for array in image.read(dtypes)])
    return worlds
