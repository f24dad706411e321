"""Digests of vehicles' rows that depend neither on zones nor on the order of rows.

The digest of a set of rows is the sum of the digests of its rows, so the digests of zones can be
added (invariant I10). It detects accidental differences, but is not cryptographic: two rows with
the same digest can be constructed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.rng import mix


@inlined_kernel
def row_digest(
    words: NDArray[np.uint64], i: int, masks: NDArray[np.uint64], factors: NDArray[np.uint64]
) -> np.uint64:
    """Return the digest of record `i`, given as whole words."""
    row = words[i]  # with a separate row, the compiler multiplies several words at once
    total = np.uint64(0)
    for n in range(row.shape[0]):
        total += (row[n] & masks[n]) * factors[n]
    return mix(total)


@kernel
def digest_rows(
    words: NDArray[np.uint64],  # (C, n) the records of vehicles as whole words
    num: int,  # number of records
    masks: NDArray[np.uint64],  # (n,) the bits of each word that count
    factors: NDArray[np.uint64],  # (n,) odd random numbers
) -> tuple[np.uint64, np.uint64]:
    """Return the upper and lower half of the digest of `words[:num]`, modulo 2**128."""
    upper = np.uint64(0)
    lower = np.uint64(0)
    for i in range(num):
        part = row_digest(words, i, masks, factors)
        lower += part
        if lower < part:
            upper += np.uint64(1)
    return upper, lower
