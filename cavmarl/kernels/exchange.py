"""Rows that go from shard to shard: ghosts every tick.

A shard's owned rows come first, its ghosts after them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.zones import ZoneArrays, zone_of

__all__ = ["take_ghosts", "take_own"]


@kernel
def take_ghosts(
    source: NDArray[np.void],
    chosen: NDArray[np.int32],
    first: int,
    last: int,
    rows: NDArray[np.void],
    num: int,
) -> None:
    """Copy `source[chosen[first:last]]` behind the first `num` rows."""
    for n in range(first, last):
        rows[num + n - first] = source[chosen[n]]


@kernel
def take_own(
    zones: ZoneArrays, zone: int, source: NDArray[np.void], num: int, rows: NDArray[np.void]
) -> int:
    """Copy the rows of `source[:num]` that lie in a zone to the front of `rows`; how many.

    `source` and `rows` may be the same array.
    """
    found = 0
    for i in range(num):
        if zone_of(zones, source[i]["x"], source[i]["y"]) == zone:
            rows[found] = source[i]
            found += 1
    return found
