"""Checks of the invariants of ownership in one pass over all rows of a world after a tick.

Sets are compared by sums of hashes, so the order of rows and zones does not matter. A vehicle is
compared with its row in the last tick. Nearly all vehicles keep their row. The other vehicles are
looked up among the vehicles that are missing from their former rows.
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
        ("late", np.int64),  # the world's tick minus the vehicle's
    ],
    align=True,
)

LOST = np.dtype(
    [
        ("id", np.int64),
        ("zone", np.int32),  # zone and row at the last check
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
        ("vehicles", np.int64),  # number of owned vehicles
        ("owned", np.uint64),  # sum of `owner_hash` of owned vehicles
        ("due", np.uint64),  # sum of the digests of other zones' vehicles that the zone must see
        ("seen", np.uint64),  # sum of the digests of its ghosts
    ],
    align=True,
)

FINDING = np.dtype(
    [
        ("kind", np.int64),
        ("vehicle", np.int64),
        ("entered", np.int64),  # number of vehicles that were not in the world at the last check
        ("left", np.int64),  # number of vehicles that have left the world since the last check
    ],
    align=True,
)


ANY_LATE = -1


class CheckTime(NamedTuple):
    """The tick of a check, and the limits that depend on it."""

    tick: int
    new_late: int  # expected `late` of an entered vehicle; ANY_LATE: not known
    limit_m: float  # longest move of a vehicle between two checks


class Kept(NamedTuple):
    """The data that one check keeps for the next."""

    rows: NDArray[np.void]  # KEPT (k, C) of the owned vehicles of each zone, in the order of rows
    num: NDArray[np.int64]  # (k,) number of owned vehicles


class Strays(NamedTuple):
    """Vehicles that have changed their row since the last check; scratch of one check."""

    table: NDArray[np.void]  # LOST (a power of two,), a hash table; blank between two checks
    places: NDArray[np.int64]  # (n,) indices in the table of missing vehicles
    rows: NDArray[np.int64]  # (n, 2) zone and row of vehicles that are new in their row
    entered: NDArray[np.int64]  # (n,) ids that were not in the world at the last check
    left: NDArray[np.int64]  # (n,) ids that have left the world since the last check


def make_kept(zones: int, capacity: int) -> Kept:
    """Return the data for a world that has not been checked yet."""
    return Kept(np.zeros((zones, capacity), KEPT), np.zeros(zones, np.int64))


def make_strays(zones: int, capacity: int) -> Strays:
    """Return scratch memory for worlds with a number of zones and of rows in each zone."""
    most = zones * capacity
    # The table is at most half full, so that searches are short.
    table = np.zeros(1 << max(2 * most - 1, 1).bit_length(), LOST)
    return Strays(table, *(np.zeros(shape, np.int64) for shape in (most, (most, 2), most, most)))


KIND_NONE = 0
KIND_TICK = 1  # a vehicle was not advanced exactly once
KIND_FAR = 2  # a vehicle is too far from its last position
KIND_SUMS = 3  # zones own or see the wrong vehicles


@kernel
def owner_hash(vehicle: int, epoch: int) -> np.uint64:
    """Return a vehicle's term in the sum over the vehicles that a zone owns."""
    return mix(mix(np.uint64(vehicle)) + np.uint64(epoch))


@kernel
def owned_sum(
    rows: NDArray[np.void],  # rows of a zone
    num: int,  # number of owned rows, which come first
) -> np.uint64:
    """Return the sum of `owner_hash` of the vehicles that a zone owns, from its rows."""
    total = np.uint64(0)
    for row in range(num):
        total += owner_hash(rows[row]["id"], rows[row]["epoch"])
    return total


@kernel
def _place(table: NDArray[np.void], vehicle: int) -> int:
    """Return the index of a vehicle in the table, or of the first blank entry after its hash."""
    last = table.shape[0] - 1
    place = np.int64(mix(np.uint64(vehicle)) & np.uint64(last))
    while table[place]["state"] != BLANK and table[place]["id"] != vehicle:
        place = (place + 1) & last
    return int(place)


@kernel
def _record_missing(strays: Strays, vehicle: int, zone: int, row: int, num: int) -> int:
    """Record the former row of a missing vehicle. Return the new number of missing vehicles."""
    place = _place(strays.table, vehicle)
    entry = strays.table[place]
    entry["id"] = vehicle
    entry["zone"] = zone
    entry["row"] = row
    entry["state"] = MISSING
    strays.places[num] = place
    return num + 1


@inlined_kernel
def _record_finding(found: np.void, kind: int, vehicle: int) -> None:
    """Record a finding, unless the recorded finding is about a vehicle with a lower id."""
    if found["kind"] == KIND_NONE or vehicle < found["vehicle"]:
        found["kind"] = kind
        found["vehicle"] = vehicle


@inlined_kernel
def _check_motion(found: np.void, last: np.void, now: np.void, limit_m: float) -> None:
    """Compare a vehicle with its state at the last check."""
    dx = now["x"] - last["x"]
    dy = now["y"] - last["y"]
    if now["late"] != last["late"]:
        _record_finding(found, KIND_TICK, now["id"])
    elif not dx * dx + dy * dy <= limit_m * limit_m:  # also true for NaN
        _record_finding(found, KIND_FAR, now["id"])


@kernel
def watch(
    zones: ZoneArrays,
    halo: Halo,  # how far each zone sees beyond its borders
    zoned: ZoneState,  # owned rows and ghosts
    words: NDArray[np.uint64],  # (2, k, W, C, n) the rows as whole words
    side: int,  # the buffer of the committed rows, 0 or 1
    w: int,
    clock: CheckTime,
    masks: NDArray[np.uint64],  # (n,) the bits that a ghost shares with its owner's row
    factors: NDArray[np.uint64],  # (n,) odd random numbers
    before: Kept,  # data of the last check
    now: Kept,  # output, for the next check
    strays: Strays,  # scratch; its `entered` and `left` are outputs
    live: int,  # expected number of vehicles
    expected: NDArray[np.uint64],  # (k,) expected `TALLY["owned"]` of each zone
    tallies: NDArray[np.void],  # TALLY (k,), output
    found: NDArray[np.void],  # FINDING (1,), output: the finding about the lowest id, if any
) -> int:
    """Check all rows of one world after a tick. Return the KIND_* of the finding."""
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
                _check_motion(finding, last, entry, clock.limit_m)
            else:
                if i < num_before:
                    missing = _record_missing(strays, last["id"], zone, i, missing)
                strays.rows[moved, 0] = zone
                strays.rows[moved, 1] = i
                moved += 1
            if not is_inside(inner, row["x"], row["y"]):
                _add_due_ghosts(zones, halo, zone, row, own_words, i, masks, factors, tallies)
        for i in range(num_owned, num_before):
            missing = _record_missing(strays, before.rows[zone, i]["id"], zone, i, missing)
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
    """Search vehicles that are new in their row among the vehicles missing from their row."""
    table = strays.table
    entered = 0
    for n in range(moved):
        entry = now.rows[strays.rows[n, 0], strays.rows[n, 1]]
        stood = table[_place(table, entry["id"])]
        if stood["state"] == MISSING:
            stood["state"] = FOUND
            _check_motion(finding, before.rows[stood["zone"], stood["row"]], entry, clock.limit_m)
        else:
            strays.entered[entered] = entry["id"]
            entered += 1
            if clock.new_late != ANY_LATE and entry["late"] != clock.new_late:
                _record_finding(finding, KIND_TICK, entry["id"])
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
def _add_due_ghosts(
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
    """Add the digest of a zone's row to the sums of the zones that must see it."""
    x = row["x"]
    y = row["y"]
    digest = np.uint64(0)
    sought = True
    here = zone_of(zones, x, y)
    for n in range(halo.near_start[here], halo.near_start[here + 1]):
        other = halo.near[n]
        if other != zone and is_seen(halo, other, row, squared_distance(zones.rects, other, x, y)):
            if sought:  # most outer rows are seen by no other zone, and need no digest
                digest = row_digest(words, i, masks, factors)
                sought = False
            tallies[other]["due"] += digest
