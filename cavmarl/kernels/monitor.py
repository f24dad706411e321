"""One look at all rows of a world after a tick: what the invariants of ownership need of them.

Sets are compared by sums of hashes, so nobody keeps lists, and neither the order of rows nor that
of zones matters. What cannot be told from sums, a vehicle's own last tick, stands in a hash table.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import inlined_kernel, kernel
from cavmarl.kernels.arrays import Zoned
from cavmarl.kernels.rng import mix
from cavmarl.kernels.zones import Halo, ZoneArrays, is_seen, squared_distance, zone_of

__all__ = [
    "FINDING",
    "KEPT",
    "KIND_DOUBLED",
    "KIND_FAR",
    "KIND_FULL",
    "KIND_NONE",
    "KIND_SUMS",
    "KIND_TICK",
    "TALLY",
    "Clock",
    "owner_hash",
    "watch",
]

KEPT = np.dtype(
    [
        ("id", np.int64),
        ("x", np.float64),
        ("y", np.float64),
        ("look", np.int32),  # number of the look that wrote this; others are blanks
        ("late", np.int32),  # the world's tick less the vehicle's
    ],
    align=True,
)

TALLY = np.dtype(
    [
        ("vehicles", np.int64),  # that the zone owns
        ("owned", np.uint64),  # sum of `owner_hash` of the zone's vehicles
        ("due", np.uint64),  # sum of the digests of others' vehicles within its halo
        ("seen", np.uint64),  # sum of the digests of its ghosts
    ],
    align=True,
)

FINDING = np.dtype([("kind", np.int64), ("vehicle", np.int64)], align=True)


class Clock(NamedTuple):
    """When a look is taken.

    Attributes:
        tick: of the world.
        look: number of this look, one more than that of the last.
        new_late: by how much the tick of a vehicle lags that was not there before.
        limit_m: no vehicle moves further from one look to the next.
    """

    tick: int
    look: int
    new_late: int
    limit_m: float


KIND_NONE = 0
KIND_DOUBLED = 1  # two zones own it, or one does twice
KIND_TICK = 2  # it was not advanced once
KIND_FAR = 3  # it is too far from where it was
KIND_FULL = 4  # there are more vehicles than a world can hold
KIND_SUMS = 5  # zones own others, or see others, than they should


@kernel
def owner_hash(vehicle: int, epoch: int) -> np.uint64:
    """What a vehicle adds to the sum of those that a zone owns."""
    return mix(mix(np.uint64(vehicle)) + np.uint64(epoch))


@inlined_kernel
def _digest(
    words: NDArray[np.uint64], i: int, masks: NDArray[np.uint64], factors: NDArray[np.uint64]
) -> np.uint64:
    row = words[i]  # so that several words are multiplied at once
    total = np.uint64(0)
    for n in range(row.shape[0]):
        total += (row[n] & masks[n]) * factors[n]
    return mix(total)


@inlined_kernel
def _place(table: NDArray[np.void], vehicle: int, hashed: np.uint64, look: int) -> int:
    """Where a vehicle of that look stands, or the first blank behind its hash; -1: no room."""
    last = table.shape[0] - 1
    place = np.int64(hashed & np.uint64(last))
    for _ in range(table.shape[0]):
        entry = table[place]
        if entry["look"] != look or entry["id"] == vehicle:
            return int(place)
        place = (place + 1) & last
    return -1


@inlined_kernel
def _note(found: np.void, kind: int, vehicle: int) -> None:
    """Keep the finding about the smallest id."""
    if found["kind"] == KIND_NONE or vehicle < found["vehicle"]:
        found["kind"] = kind
        found["vehicle"] = vehicle


@inlined_kernel
def _judge(
    row: np.void,
    hashed: np.uint64,
    clock: Clock,
    before: NDArray[np.void],
    now: NDArray[np.void],
) -> int:
    """KIND_* of an owned row beside that of the tick before; `now` is written."""
    vehicle = row["id"]
    look = clock.look
    late = clock.tick - row["tick"]
    place = _place(now, vehicle, hashed, look)
    if place < 0:
        return KIND_FULL
    entry = now[place]
    if entry["look"] == look:
        return KIND_DOUBLED
    entry["id"] = vehicle
    entry["x"] = row["x"]
    entry["y"] = row["y"]
    entry["look"] = look
    entry["late"] = late
    place = _place(before, vehicle, hashed, look - 1)
    if place < 0 or before[place]["look"] != look - 1:
        return KIND_TICK if late != clock.new_late else KIND_NONE
    last = before[place]
    if late != last["late"]:
        return KIND_TICK
    dx = row["x"] - last["x"]
    dy = row["y"] - last["y"]
    return KIND_NONE if dx * dx + dy * dy <= clock.limit_m * clock.limit_m else KIND_FAR


@kernel
def watch(
    zones: ZoneArrays,
    halo: Halo,
    zoned: Zoned,
    words: NDArray[np.uint64],
    side: int,
    w: int,
    clock: Clock,
    masks: NDArray[np.uint64],
    factors: NDArray[np.uint64],
    before: NDArray[np.void],
    now: NDArray[np.void],
    live: int,
    expected: NDArray[np.uint64],
    tallies: NDArray[np.void],
    found: NDArray[np.void],
) -> int:
    """Look at all rows of one world after a tick; KIND_* of what is found.

    Args:
        zones: of the partition.
        halo: how far each zone sees over its borders.
        zoned: the rows, owned ones and ghosts.
        words: (2, k, W, C, n) the rows as whole words.
        side: where the committed rows are, 0 or 1.
        w: which world.
        clock: of it.
        masks: (n,) which bits a ghost has in common with its owner's row.
        factors: (n,) odd random numbers.
        before: KEPT (a power of two,), what the last look wrote.
        now: KEPT, of the same size; what the last look but one wrote counts as blank.
        live: vehicles that there should be.
        expected: (k,) what `TALLY["owned"]` should be of each zone.
        tallies: TALLY (k,) overwritten.
        found: FINDING (1,) overwritten: the one about the smallest id, if there is any.
    """
    found[0]["kind"] = KIND_NONE
    count = zones.rects.shape[0]
    for zone in range(count):
        tallies[zone]["owned"] = 0
        tallies[zone]["due"] = 0
        tallies[zone]["seen"] = 0
    for zone in range(count):
        rows = zoned.rows[side, zone, w]
        num_owned = zoned.num_owned[zone, w]
        owned = np.uint64(0)
        for i in range(num_owned):
            row = rows[i]
            hashed = mix(np.uint64(row["id"]))
            owned += mix(hashed + np.uint64(row["epoch"]))
            kind = _judge(row, hashed, clock, before, now)
            if kind != KIND_NONE:
                _note(found[0], kind, row["id"])
        tallies[zone]["vehicles"] = num_owned
        tallies[zone]["owned"] = owned
        _owe_ghosts(
            zones, halo, zone, rows, words[side, zone, w], num_owned, masks, factors, tallies
        )
        seen = np.uint64(0)
        for i in range(num_owned, zoned.num_rows[zone, w]):
            seen += _digest(words[side, zone, w], i, masks, factors)
        tallies[zone]["seen"] = seen
    if found[0]["kind"] == KIND_NONE:
        for zone in range(count):
            tally = tallies[zone]
            live -= tally["vehicles"]
            if tally["owned"] != expected[zone] or tally["due"] != tally["seen"]:
                return KIND_SUMS
        return KIND_NONE if live == 0 else KIND_SUMS
    return int(found[0]["kind"])


@inlined_kernel
def _owe_ghosts(
    zones: ZoneArrays,
    halo: Halo,
    zone: int,
    rows: NDArray[np.void],
    words: NDArray[np.uint64],
    num_owned: int,
    masks: NDArray[np.uint64],
    factors: NDArray[np.uint64],
    tallies: NDArray[np.void],
) -> None:
    """Add a zone's rows to what those zones have to see that they are near to."""
    min_x, min_y = halo.inner[zone, 0], halo.inner[zone, 1]
    max_x, max_y = halo.inner[zone, 2], halo.inner[zone, 3]
    for i in range(num_owned):
        x = rows[i]["x"]
        y = rows[i]["y"]
        if min_x < x and x < max_x and min_y < y and y < max_y:
            continue
        digest = np.uint64(0)
        sought = True
        here = zone_of(zones, x, y)
        for n in range(halo.near_start[here], halo.near_start[here + 1]):
            other = halo.near[n]
            if other != zone and is_seen(
                halo, other, rows[i], squared_distance(zones.rects, other, x, y)
            ):
                if sought:  # many out here are seen by nobody
                    digest = _digest(words, i, masks, factors)
                    sought = False
                tallies[other]["due"] += digest
