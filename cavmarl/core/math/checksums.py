"""A checksum of many bytes, several times as fast as a CRC: whether they are those that were sent.

It is no secret, and guards against accidents alone.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel, unchecked

LARGE = 1 << 12  # bytes; of fewer the CRC is as fast
_PRIME = np.uint64(0x9E3779B97F4A7C15)
_SHIFT = np.uint64(29)
_HIGH = np.uint64(32)


@kernel
def mixed(words: NDArray[np.uint64]) -> int:
    """32 bits that depend on each word and on its place, in four chains side by side."""
    first = np.uint64(words.size)
    second = third = fourth = _PRIME
    last = words.size - words.size % 4
    for n in range(0, last, 4):
        first = _step(first, words[n])
        second = _step(second, words[n + 1])
        third = _step(third, words[n + 2])
        fourth = _step(fourth, words[n + 3])
    for n in range(last, words.size):
        first = _step(first, words[n])
    return int(_step(_step(_step(first, second), third), fourth) >> _HIGH)


@inlined_kernel
def _step(state: np.uint64, word: np.uint64) -> np.uint64:
    state = (state ^ word) * _PRIME
    return state ^ (state >> _SHIFT)


_mixed = unchecked(mixed)


def checksum(data: bytes | bytearray | memoryview) -> int:
    """32 bits of some bytes: a CRC; of many that of the last few, begun with those of the rest."""
    if len(data) < LARGE:
        return crc32(data)
    num = len(data) // 8
    return crc32(data[8 * num :], _mixed(np.frombuffer(data, np.uint64, num)))
