"""`RowDigests`: digests of sets of vehicles, by what they are and not by who owns them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels.digests import digest_rows
from cavmarl.shard.vehicles import STATE_FIELDS, VEHICLE

__all__ = ["RowDigests"]

WORD = np.dtype(np.uint64).itemsize


class RowDigests:
    """Digests of rows, which add up: that of two zones is the sum of theirs modulo 2**128."""

    def __init__(self) -> None:
        blank = np.zeros(1, dtype=VEHICLE)
        for name in STATE_FIELDS:
            blank[name].view(np.uint8)[:] = 0xFF
        self._masks = blank.view(np.uint64)
        rng = np.random.Generator(np.random.Philox(key=0))
        factors = rng.integers(0, 1 << 64, len(self._masks), dtype=np.uint64)
        self._factors = factors | np.uint64(1)

    def of(self, rows: NDArray[np.void]) -> int:
        """Of VEHICLE (n,), in [0, 2**128)."""
        words = rows.view(np.uint64).reshape(len(rows), len(self._masks))
        upper, lower = digest_rows(words, len(rows), self._masks, self._factors)
        return (int(upper) << 64) | int(lower)
