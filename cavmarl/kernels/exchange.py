"""Rows that go from shard to shard: ghosts every tick, and vehicles that change their owner.

A shard's owned rows come first, its ghosts after them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.zones import ZoneArrays, squared_distance, zone_of

__all__ = ["adopt", "find_movers", "release", "take_ghosts", "take_own"]


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


@kernel
def find_movers(
    zones: ZoneArrays,
    zone: int,
    hysteresis_m: float,
    rows: NDArray[np.void],
    num: int,
    out: NDArray[np.int32],
) -> int:
    """The owned rows that lie further than the hysteresis outside of their zone; how many.

    Args:
        zones: of the partition.
        zone: the shard's own.
        hysteresis_m: so far behind the border a vehicle still stays.
        rows: VEHICLE (C,).
        num: owned rows.
        out: (C,) overwritten with rows.
    """
    limit = hysteresis_m * hysteresis_m
    found = 0
    for i in range(num):
        if squared_distance(zones.rects, zone, rows[i]["x"], rows[i]["y"]) > limit:
            out[found] = i
            found += 1
    return found


@kernel
def release(rows: NDArray[np.void], i: int, num_owned: int, spare: NDArray[np.void]) -> None:
    """Make the owned row i the first ghost, and the last owned one take its place."""
    spare[0] = rows[i]
    rows[i] = rows[num_owned - 1]
    rows[num_owned - 1] = spare[0]


@kernel
def adopt(rows: NDArray[np.void], num_owned: int, num_rows: int, row: np.void) -> bool:
    """Make the ghost of a vehicle the last owned row, in the state of `row`; False: no ghost."""
    for i in range(num_owned, num_rows):
        if rows[i]["id"] == row["id"]:
            rows[i] = rows[num_owned]
            rows[num_owned] = row
            return True
    return False
