"""Digests of vehicles' rows that know neither zones nor the order of rows.

The digest of a set of rows is the sum of the rows' own, so zones can be added up (invariant I10).
It tells of any accidental difference; it is no protection against a search for two rows of one
digest.
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
    """That of one of the records, as whole words."""
    row = words[i]  # so that several words are multiplied at once
    total = np.uint64(0)
    for n in range(row.shape[0]):
        total += (row[n] & masks[n]) * factors[n]
    return mix(total)


@kernel
def digest_rows(
    words: NDArray[np.uint64],  # (C, n) the records of vehicles as whole words
    num: int,  # how many count
    masks: NDArray[np.uint64],  # (n,) which bits of each word count
    factors: NDArray[np.uint64],  # (n,) odd random numbers
) -> tuple[np.uint64, np.uint64]:
    """Upper and lower half of the sum of the digests of `words[:num]`, modulo 2**128."""
    upper = np.uint64(0)
    lower = np.uint64(0)
    for i in range(num):
        part = row_digest(words, i, masks, factors)
        lower += part
        if lower < part:
            upper += np.uint64(1)
    return upper, lower
