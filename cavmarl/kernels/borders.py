"""Vehicles at the borders of zones: who has crossed, who is about to, and how rows change hands."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.zones import ZoneArrays, squared_distance, zone_of

__all__ = ["NEAR", "find_near", "pass_on"]

NEAR = np.dtype(
    [
        ("vehicle", np.int64),
        ("row", np.int64),  # where the owner keeps it
        ("target", np.int64),  # zone that it is in, or will be in
        ("crossed", np.bool_),  # it is further than the hysteresis outside of its owner's zone
        ("depth_m", np.float64),  # how far outside it is; 0 inside
    ],
    align=True,
)


@kernel
def find_near(
    zones: ZoneArrays,
    zone: int,
    hysteresis_m: float,
    ahead_s: float,
    max_speed_mps: float,
    rows: NDArray[np.void],
    num: int,
    out: NDArray[np.void],
) -> int:
    """The owned rows that other zones have to be told of; how many entries there are.

    A vehicle is near a zone that it lies in, further than the hysteresis outside of its own, and
    one that it would lie in so after `ahead_s` at its present velocity.

    Args:
        zones: of the partition.
        zone: the shard's own.
        hysteresis_m: so far behind the border a vehicle still stays.
        ahead_s: how far ahead to look, s.
        max_speed_mps: which no vehicle exceeds.
        rows: VEHICLE (C,).
        num: owned rows.
        out: NEAR (2 C,) overwritten: by rows, a crossing before an approach.
    """
    limit = hysteresis_m * hysteresis_m
    # Whoever lies further inside cannot come out in that time. Infinite rims stay infinite.
    margin = max_speed_mps * ahead_s
    min_x = zones.rects[zone, 0] + margin
    min_y = zones.rects[zone, 1] + margin
    max_x = zones.rects[zone, 2] - margin
    max_y = zones.rects[zone, 3] - margin
    found = 0
    for i in range(num):
        x = rows[i]["x"]
        y = rows[i]["y"]
        if min_x < x and x < max_x and min_y < y and y < max_y:
            continue
        squared = squared_distance(zones.rects, zone, x, y)
        here = zone
        if squared > limit:
            here = zone_of(zones, x, y)
            _note(out[found], rows[i]["id"], i, here, True, squared)
            found += 1
        way = rows[i]["speed"] * ahead_s
        then_x = x + math.cos(rows[i]["heading"]) * way
        then_y = y + math.sin(rows[i]["heading"]) * way
        if squared_distance(zones.rects, zone, then_x, then_y) > limit:
            there = zone_of(zones, then_x, then_y)
            if there != here:
                _note(out[found], rows[i]["id"], i, there, False, squared)
                found += 1
    return found


@kernel
def _note(
    entry: np.void, vehicle: int, row: int, target: int, crossed: bool, squared: float
) -> None:
    entry["vehicle"] = vehicle
    entry["row"] = row
    entry["target"] = target
    entry["crossed"] = crossed
    entry["depth_m"] = math.sqrt(squared)


@kernel
def pass_on(
    vehicle: int,
    source: NDArray[np.void],
    source_owned: NDArray[np.int64],
    row: int,
    target: NDArray[np.void],
    target_owned: NDArray[np.int64],
    target_rows: NDArray[np.int64],
    w: int,
    spare: NDArray[np.void],
) -> int:
    """Make a vehicle a ghost of the zone that owned it, and an owned row where it was a ghost.

    Args:
        vehicle: its id.
        source: VEHICLE (W, C), of the shard that owns it.
        source_owned: (W,) owned rows there; becomes one less.
        row: where it probably is there.
        target: VEHICLE (W, C), of the shard that will own it.
        target_owned: (W,) owned rows there; becomes one more.
        target_rows: (W,) owned rows and ghosts there.
        w: in which world.
        spare: VEHICLE (1,), room.

    Returns:
        its row at the target, with what the ghost said; -1: the source does not own it; -2: the
        target has no ghost of it.
    """
    owned = source_owned[w]
    if row >= owned or source[w, row]["id"] != vehicle:
        row = 0
        while row < owned and source[w, row]["id"] != vehicle:
            row += 1
        if row == owned:
            return -1
    place: int = target_owned[w]
    ghost = place
    while ghost < target_rows[w] and target[w, ghost]["id"] != vehicle:
        ghost += 1
    if ghost == target_rows[w]:
        return -2
    _swap(target[w], ghost, place, spare)
    target_owned[w] = place + 1
    _swap(source[w], row, owned - 1, spare)
    source_owned[w] = owned - 1
    return place


@kernel
def _swap(rows: NDArray[np.void], i: int, j: int, spare: NDArray[np.void]) -> None:
    if i != j:
        spare[0] = rows[i]
        rows[i] = rows[j]
        rows[j] = spare[0]
