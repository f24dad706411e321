"""One look at all rows of a world after a tick: what the invariants of ownership need of them.

Sets are compared by sums of hashes, so neither the order of rows nor that of zones matters. What
cannot be told from sums, a vehicle's own last tick, stands where its row does: nearly all stay
there. Vehicles on another row are searched among those that are not where they were.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.rng import mix
from cavmarl.core.records.arrays import ZoneState
from cavmarl.handoff.kernels.digests import row_digest
from cavmarl.zones.kernels.zone_lookup import (
    Halo,
    ZoneArrays,
    is_inside,
    is_seen,
    squared_distance,
    zone_of,
)

KEPT = np.dtype(
    [
        ("id", np.int64),
        ("x", np.float64),
        ("y", np.float64),
        ("late", np.int64),  # the world's tick less the vehicle's
    ],
    align=True,
)

LOST = np.dtype(
    [
        ("id", np.int64),
        ("zone", np.int32),  # where the last check has seen it
        ("row", np.int32),
        ("state", np.int64),  # BLANK, MISSING or FOUND
    ],
    align=True,
)
BLANK = 0
MISSING = 1
FOUND = 2

TALLY = np.dtype(
    [
        ("vehicles", np.int64),  # that the zone owns
        ("owned", np.uint64),  # sum of `owner_hash` of the zone's vehicles
        ("due", np.uint64),  # sum of the digests of others' vehicles within its halo
        ("seen", np.uint64),  # sum of the digests of its ghosts
    ],
    align=True,
)

FINDING = np.dtype(
    [
        ("kind", np.int64),
        ("vehicle", np.int64),
        ("entered", np.int64),  # vehicles that the last check has not seen
        ("left", np.int64),  # that this one has not seen
    ],
    align=True,
)


ANY_LATE = -1


class CheckTime(NamedTuple):
    """When a check is made."""

    tick: int
    # by how much the tick of a vehicle lags that was not there before; ANY_LATE: it is not known
    new_late: int
    limit_m: float  # no vehicle moves further from one check to the next


class Kept(NamedTuple):
    """What one check leaves for the next."""

    # KEPT (k, C) of the vehicles that each zone owns, in the order of its rows
    rows: NDArray[np.void]
    num: NDArray[np.int64]  # (k,) how many


class Strays(NamedTuple):
    """Vehicles that are not where the last check has seen them; scratch of one check."""

    table: NDArray[np.void]  # LOST (a power of two,), a hash table; blank between two checks
    places: NDArray[np.int64]  # (n,) where in it a vehicle stands
    rows: NDArray[np.int64]  # (n, 2) zone and row where another stood
    entered: NDArray[np.int64]  # (n,) vehicles that the last check has not seen
    left: NDArray[np.int64]  # (n,) vehicles that this one has not seen


def make_kept(zones: int, capacity: int) -> Kept:
    """Of a world not checked yet."""
    return Kept(np.zeros((zones, capacity), KEPT), np.zeros(zones, np.int64))


def make_strays(zones: int, capacity: int) -> Strays:
    """For worlds of so many zones and rows in each; what is not needed is never touched."""
    most = zones * capacity
    # Half empty, so that places are found at once.
    table = np.zeros(1 << max(2 * most - 1, 1).bit_length(), LOST)
    return Strays(table, *(np.zeros(shape, np.int64) for shape in (most, (most, 2), most, most)))


KIND_NONE = 0
KIND_TICK = 1  # it was not advanced once
KIND_FAR = 2  # it is too far from where it was
KIND_SUMS = 3  # zones own others, or see others, than they should


@kernel
def owner_hash(vehicle: int, epoch: int) -> np.uint64:
    """What a vehicle adds to the sum of those that a zone owns."""
    return mix(mix(np.uint64(vehicle)) + np.uint64(epoch))


@kernel
def owned_sum(
    rows: NDArray[np.void],  # of a zone
    num: int,  # how many it owns; they come first
) -> np.uint64:
    """The sum of `owner_hash` of the vehicles that a zone owns, as its rows say."""
    total = np.uint64(0)
    for row in range(num):
        total += owner_hash(rows[row]["id"], rows[row]["epoch"])
    return total


@kernel
def _place(table: NDArray[np.void], vehicle: int) -> int:
    """Where a vehicle stands, or the first blank behind its hash."""
    last = table.shape[0] - 1
    place = np.int64(mix(np.uint64(vehicle)) & np.uint64(last))
    while table[place]["state"] != BLANK and table[place]["id"] != vehicle:
        place = (place + 1) & last
    return int(place)


@kernel
def _miss(strays: Strays, vehicle: int, zone: int, row: int, num: int) -> int:
    """Note where a missing vehicle stood; returns how many are noted, `num` before."""
    place = _place(strays.table, vehicle)
    entry = strays.table[place]
    entry["id"] = vehicle
    entry["zone"] = zone
    entry["row"] = row
    entry["state"] = MISSING
    strays.places[num] = place
    return num + 1


@inlined_kernel
def _note(found: np.void, kind: int, vehicle: int) -> None:
    """Keep the finding about the smallest id."""
    if found["kind"] == KIND_NONE or vehicle < found["vehicle"]:
        found["kind"] = kind
        found["vehicle"] = vehicle


@inlined_kernel
def _judge(found: np.void, last: np.void, now: np.void, limit_m: float) -> None:
    """Compare a vehicle with what it was at the last check."""
    dx = now["x"] - last["x"]
    dy = now["y"] - last["y"]
    if now["late"] != last["late"]:
        _note(found, KIND_TICK, now["id"])
    elif not dx * dx + dy * dy <= limit_m * limit_m:  # nor where it is nowhere
        _note(found, KIND_FAR, now["id"])


@kernel
def watch(
    zones: ZoneArrays,
    halo: Halo,  # how far each zone sees over its borders
    zoned: ZoneState,  # the rows, owned ones and ghosts
    words: NDArray[np.uint64],  # (2, k, W, C, n) the rows as whole words
    side: int,  # where the committed rows are, 0 or 1
    w: int,
    clock: CheckTime,
    masks: NDArray[np.uint64],  # (n,) which bits a ghost has in common with its owner's row
    factors: NDArray[np.uint64],  # (n,) odd random numbers
    before: Kept,  # what the last check wrote
    now: Kept,  # overwritten, for the next check
    strays: Strays,  # scratch; entered and left are overwritten
    live: int,  # vehicles that there should be
    expected: NDArray[np.uint64],  # (k,) what `TALLY["owned"]` should be of each zone
    tallies: NDArray[np.void],  # TALLY (k,) overwritten
    # FINDING (1,) overwritten: the one about the smallest id, if there is any
    found: NDArray[np.void],
) -> int:
    """Look at all rows of one world after a tick; KIND_* of what is found."""
    finding = found[0]
    finding["kind"] = KIND_NONE
    count = zones.rects.shape[0]
    for zone in range(count):
        tallies[zone]["due"] = 0
    missing = moved = 0
    for zone in range(count):
        rows = zoned.rows[side, zone, w]
        own_words = words[side, zone, w]
        num_owned = zoned.num_owned[zone, w]
        num_before = before.num[zone]
        inner = halo.inner[zone]
        owned = np.uint64(0)
        for i in range(num_owned):
            row = rows[i]
            entry = now.rows[zone, i]
            entry["id"] = row["id"]
            entry["x"] = row["x"]
            entry["y"] = row["y"]
            entry["late"] = clock.tick - row["tick"]
            owned += owner_hash(row["id"], row["epoch"])
            last = before.rows[zone, i]
            if i < num_before and last["id"] == entry["id"]:
                _judge(finding, last, entry, clock.limit_m)
            else:
                if i < num_before:
                    missing = _miss(strays, last["id"], zone, i, missing)
                strays.rows[moved, 0] = zone
                strays.rows[moved, 1] = i
                moved += 1
            if not is_inside(inner, row["x"], row["y"]):
                _owe_ghosts(zones, halo, zone, row, own_words, i, masks, factors, tallies)
        for i in range(num_owned, num_before):
            missing = _miss(strays, before.rows[zone, i]["id"], zone, i, missing)
        now.num[zone] = num_owned
        tallies[zone]["vehicles"] = num_owned
        tallies[zone]["owned"] = owned
        seen = np.uint64(0)
        for i in range(num_owned, zoned.num_rows[zone, w]):
            seen += row_digest(own_words, i, masks, factors)
        tallies[zone]["seen"] = seen
    _match(before, now, clock, strays, missing, moved, finding)
    if finding["kind"] == KIND_NONE:
        for zone in range(count):
            tally = tallies[zone]
            live -= tally["vehicles"]
            if tally["owned"] != expected[zone] or tally["due"] != tally["seen"]:
                return KIND_SUMS
        return KIND_NONE if live == 0 else KIND_SUMS
    return int(finding["kind"])


@kernel
def _match(
    before: Kept,
    now: Kept,
    clock: CheckTime,
    strays: Strays,
    missing: int,
    moved: int,
    finding: np.void,
) -> None:
    """Search vehicles on other rows among those that are not where they were."""
    table = strays.table
    entered = 0
    for n in range(moved):
        entry = now.rows[strays.rows[n, 0], strays.rows[n, 1]]
        stood = table[_place(table, entry["id"])]
        if stood["state"] == MISSING:
            stood["state"] = FOUND
            _judge(finding, before.rows[stood["zone"], stood["row"]], entry, clock.limit_m)
        else:
            strays.entered[entered] = entry["id"]
            entered += 1
            if clock.new_late != ANY_LATE and entry["late"] != clock.new_late:
                _note(finding, KIND_TICK, entry["id"])
    left = 0
    for n in range(missing):
        stood = table[strays.places[n]]
        if stood["state"] == MISSING:
            strays.left[left] = stood["id"]
            left += 1
        stood["state"] = BLANK
    finding["entered"] = entered
    finding["left"] = left


@inlined_kernel
def _owe_ghosts(
    zones: ZoneArrays,
    halo: Halo,
    zone: int,
    row: np.void,
    words: NDArray[np.uint64],
    i: int,
    masks: NDArray[np.uint64],
    factors: NDArray[np.uint64],
    tallies: NDArray[np.void],
) -> None:
    """Add a zone's row to what those zones have to see that it is near to."""
    x = row["x"]
    y = row["y"]
    digest = np.uint64(0)
    sought = True
    here = zone_of(zones, x, y)
    for n in range(halo.near_start[here], halo.near_start[here + 1]):
        other = halo.near[n]
        if other != zone and is_seen(halo, other, row, squared_distance(zones.rects, other, x, y)):
            if sought:  # many out here are seen by none
                digest = row_digest(words, i, masks, factors)
                sought = False
            tallies[other]["due"] += digest
