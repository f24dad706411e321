"""Compute the findings of the monitor with Python sets and integers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.naive.digests import WORD, digest, mixed
from tests.naive.zones import distance


class Kept(NamedTuple):
    """The position of a vehicle at the previous tick, and the lateness of its row in ticks."""

    x: float
    y: float
    late: int


class Zone(NamedTuple):
    """The VEHICLE records of a zone."""

    owned: NDArray[np.void]
    ghosts: NDArray[np.void]


def owner_hash(vehicle: int, epoch: int) -> int:
    """Return the hash of a vehicle in the sum of hashes of its owner."""
    return mixed((mixed(vehicle) + epoch) & WORD)


def findings(
    zones: list[Zone], before: Mapping[int, Kept], tick: int, new_late: int, limit_m: float
) -> dict[int, str]:
    """Return the faults by vehicle: `tick` (wrong tick) or `far` (too far from its last place)."""
    found: dict[int, str] = {}
    for zone in zones:
        for row in zone.owned:
            last = before.get(int(row["id"]))
            if tick - row["tick"] != (new_late if last is None else last.late):
                found[int(row["id"])] = "tick"
            elif last is not None:
                way = (row["x"] - last.x) ** 2 + (row["y"] - last.y) ** 2
                if way > limit_m * limit_m:
                    found[int(row["id"])] = "far"
    return found


def tallies(
    zones: list[Zone],
    rects: NDArray[np.float64],
    halo_m: float,
    masks: list[int],
    factors: list[int],
) -> list[tuple[int, int, int, int]]:
    """Return per zone: number of vehicles, sum of owner hashes, digests of due and present ghosts.

    Due ghosts are the owned rows of other zones within `halo_m` of the zone.
    """

    def sum_of(rows: list[np.void]) -> int:
        words = [np.frombuffer(row.tobytes(), np.uint64).tolist() for row in rows]
        return digest(words, masks, factors) & WORD

    result = []
    for z, zone in enumerate(zones):
        due = [
            row
            for other, part in enumerate(zones)
            if other != z
            for row in part.owned
            if distance(rects[z], row["x"], row["y"]) <= halo_m
        ]
        owned = sum(owner_hash(int(row["id"]), int(row["epoch"])) for row in zone.owned) & WORD
        result.append((len(zone.owned), owned, sum_of(due), sum_of(list(zone.ghosts))))
    return result
