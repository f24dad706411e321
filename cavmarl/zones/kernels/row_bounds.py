"""Bounds checks of the indices in vehicle rows that other processes send."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel

Words = NDArray[np.int64]

Bounds = NDArray[np.int64]
"""(k, 4) for each index: its word in a row; its first bit in the word, or `WHOLE` or `WITH_LANE`;
its minimum; and the first value that is too large."""

WHOLE = -1  # the index takes the whole word, not 32 bits
WITH_LANE = -2  # the index is the sum of the whole word and the row's lane
_LANE = 5  # offset of the word that has the lane in its low half
_LOW = np.int64((1 << 32) - 1)
_SIGN = np.int64(1 << 31)


@inlined_kernel
def _half(word: int, bit: int) -> int:
    """Return the signed 32-bit number that begins at a bit of a word."""
    return int(((word >> bit & _LOW) ^ _SIGN) - _SIGN)


@inlined_kernel
def is_bounded(row: Words, bounds: Bounds) -> bool:
    """Return whether all indices of a row are within their bounds."""
    for n in range(bounds.shape[0]):
        value = row[bounds[n, 0]]
        bit = bounds[n, 1]
        if bit >= 0:
            value = _half(value, bit)
        elif bit == WITH_LANE:
            value += _half(row[_LANE], 0)
        if value < bounds[n, 2] or value >= bounds[n, 3]:
            return False
    return True


@kernel
def are_bounded(rows: Words, bounds: Bounds) -> bool:
    """Return whether all indices of all rows (n, words) are within their bounds."""
    for n in range(rows.shape[0]):
        if not is_bounded(rows[n], bounds):
            return False
    return True
