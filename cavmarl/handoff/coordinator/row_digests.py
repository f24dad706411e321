"""`RowDigests`: digests of sets of vehicles that do not depend on the owners."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from cavmarl.driving.vehicles import STATE_FIELDS, VEHICLE
from cavmarl.handoff.kernels.digests import digest_rows


def digest_tables(fields: Iterable[str]) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Return masks and factors (n,) of the words of VEHICLE, for digests of some fields."""
    blank = np.zeros(1, dtype=VEHICLE)
    for name in fields:
        blank[name].view(np.uint8)[:] = 0xFF
    masks = blank.view(np.uint64)
    rng = np.random.Generator(np.random.Philox(key=0))
    factors = rng.integers(0, 1 << 64, len(masks), dtype=np.uint64)
    return masks, factors | np.uint64(1)


class RowDigests:
    """Additive digests: the digest of the rows of two zones is the sum modulo 2**128."""

    def __init__(self) -> None:
        self._masks, self._factors = digest_tables(STATE_FIELDS)

    def of(self, rows: NDArray[np.void]) -> int:
        """Return the digest of VEHICLE (n,), in [0, 2**128)."""
        words = rows.view(np.uint64).reshape(len(rows), len(self._masks))
        upper, lower = digest_rows(words, len(rows), self._masks, self._factors)
        return (int(upper) << 64) | int(lower)
