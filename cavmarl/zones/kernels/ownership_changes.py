"""Approaches to borders, and changes of owner, if one process has all zones.

`BorderRecords` stores them. Vehicles near a border are recorded at the end of a tick, together with
the exchange of ghosts. In most ticks no vehicle has crossed, so the next tick has nothing to do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import ZoneState
from cavmarl.zones.kernels.borders import NEAR, Borders, find_near, pass_on
from cavmarl.zones.kernels.zone_lookup import ZoneArrays, squared_distance

# Results of `hand_over` and `pass_on` if they fail.
NOT_OWNED = -1
NOT_SEEN = -2

COMING = np.dtype(
    [
        ("vehicle", np.int64),
        ("target", np.int64),  # zone that the vehicle approaches
        ("epoch", np.int64),  # epoch of the current ownership
        ("tick", np.int64),  # first tick in which the vehicle was near
        ("depth_m", np.float64),  # distance outside of its owner's zone in that tick, see NEAR
        ("ms", np.float64),  # clock time at the start of that tick, ms
    ],
    align=True,
)

CHANGE = np.dtype(
    [
        ("tick", np.int64),  # first tick that the new owner computes
        ("vehicle", np.int64),
        ("source", np.int64),
        ("target", np.int64),
        ("epoch", np.int64),  # epoch of the new ownership
        ("place", np.int64),  # the vehicle's row at the target
        ("approached", np.int64),  # first tick in which the vehicle was near
        ("prepare_depth_m", np.float64),  # distance outside of the source's zone in that tick
        ("switch_depth_m", np.float64),  # the same distance at the change of owner
        ("release_depth_m", np.float64),  # the same one tick later; NaN: the vehicle has left
        # ms since the first approach; until the tick ends, clock time of the first approach in ms
        ("ms", np.float64),
    ],
    align=True,
)


DUE = np.dtype(
    [
        ("row", np.int32),  # index of the row at its owner
        ("zone", np.int32),  # zone that needs the row
        ("near", np.bool_),  # whether the vehicle can touch a vehicle of that zone
        ("at_border", np.bool_),  # whether the vehicle is at a border of that zone
    ],
    align=True,
)
"""A row that must be copied to a zone as a ghost."""

BATCH_SIZE = 512
"""Size of a batch of rows to copy; larger than the largest number of zones."""

UNREAD_LIMIT = 256
"""The coordinator reads changes once this many are unread. A tick adds at most one per vehicle."""


class BorderRecords(NamedTuple):
    """Approaches and changes of owner at the borders of W worlds, with room for C rows per zone."""

    near: NDArray[np.void]  # NEAR (W, 2 C) vehicles near borders, in the newest rows
    num_near: NDArray[np.int64]  # (W,) number of entries of `near`
    num_crossed: NDArray[np.int64]  # (W,) number of vehicles in `near` that have crossed
    owned: NDArray[np.int64]  # (W,) number of vehicles when `near` was made
    coming: NDArray[np.void]  # COMING (W, 2, 2 C) near, not handed over; two alternating lists
    turn: NDArray[np.int64]  # (W,) index of the current list; the other is the previous tick's
    num_coming: NDArray[np.int64]  # (W, 2) number of entries of both lists
    known: NDArray[np.int64]  # (W,) entries of the current list that were in the previous list
    acknowledged: NDArray[np.int64]  # (W,) sum of the entries of `coming` in all earlier ticks
    aborted: NDArray[np.int64]  # (W,) number of vehicles that have turned back or left the world
    tick: NDArray[np.int64]  # (W,) tick of the rows in which `near` was found
    ms: NDArray[np.float64]  # (W,) clock time at the start of that tick, ms
    newborn: NDArray[np.int64]  # (W, C) ids that have entered since the last tick began
    changes: NDArray[np.void]  # CHANGE (W, C + UNREAD_LIMIT) that are not read yet
    num_changes: NDArray[np.int64]  # (W,) number of entries of `changes`
    due: NDArray[np.void]  # DUE (BATCH_SIZE,) scratch of `exchange`


def make_book(num_worlds: int, capacity: int) -> BorderRecords:
    def numbers(*shape: int) -> NDArray[np.int64]:
        return np.zeros((num_worlds, *shape), np.int64)

    return BorderRecords(
        near=np.zeros((num_worlds, 2 * capacity), NEAR),
        num_near=numbers(),
        num_crossed=numbers(),
        owned=numbers(),
        coming=np.zeros((num_worlds, 2, 2 * capacity), COMING),
        turn=numbers(),
        num_coming=numbers(2),
        known=numbers(),
        acknowledged=numbers(),
        aborted=numbers(),
        tick=numbers(),
        ms=np.zeros(num_worlds),
        newborn=numbers(capacity),
        changes=np.zeros((num_worlds, capacity + UNREAD_LIMIT), CHANGE),
        num_changes=numbers(),
        due=np.zeros(BATCH_SIZE, DUE),
    )


@kernel
def look(
    zones: ZoneArrays,
    borders: Borders,
    zoned: ZoneState,  # the rows of all zones
    side: int,  # the buffer of rows, 0 or 1
    w: int,
    check_all: bool,  # whether to check all owned rows, see `find_near`
    num_newborn: int,  # vehicles in `book.newborn[w, :num_newborn]` are left out
    book: BorderRecords,  # outputs: `near` and `coming`
) -> None:
    """Record vehicles that are near a border or have crossed it."""
    near = book.near[w]
    found = find_near(zones, borders, zoned, side, w, check_all, near)
    num = 0
    crossed = 0
    for n in range(found):
        if not _is_newborn(book, w, num_newborn, near[n]["vehicle"]):
            near[num] = near[n]
            crossed += near[n]["crossed"]
            num += 1
    book.num_near[w] = num
    book.num_crossed[w] = crossed
    owned = 0
    for zone in range(zones.rects.shape[0]):
        owned += zoned.num_owned[zone, w]
    book.owned[w] = owned
    _renew(zoned, side, w, book)


@kernel
def look_on(
    zones: ZoneArrays, borders: Borders, zoned: ZoneState, side: int, w: int, book: BorderRecords
) -> None:
    """Run `look` on the rows of the next tick."""
    now = book.turn[w]
    book.tick[w] += 1
    book.acknowledged[w] += book.num_near[w]
    book.aborted[w] += book.num_coming[w, 1 - now] - book.known[w]
    book.turn[w] = 1 - now
    look(zones, borders, zoned, side, w, False, 0, book)


@kernel
def hand_over(
    zones: ZoneArrays,
    borders: Borders,
    zoned: ZoneState,  # the rows of all zones
    side: int,  # the buffer of rows, 0 or 1
    w: int,
    check_all: bool,  # whether rows have changed since `look_on`
    num_newborn: int,  # see `look`
    book: BorderRecords,  # output
) -> int:
    """Give every vehicle beyond its zone's hysteresis to the zone that contains it.

    Returns:
        The number of changes, which are at the end of `book.changes` in ascending order of ids. If
        a change fails: NOT_OWNED or NOT_SEEN, and the failed change follows the other changes.
    """
    if check_all:
        look(zones, borders, zoned, side, w, True, num_newborn, book)
    near = book.near[w]
    changed = 0
    last = -1
    while True:
        n = _next_crossed(near, book.num_near[w], last)
        if n < 0:
            book.num_crossed[w] = 0
            return changed
        last = near[n]["vehicle"]
        place = _change(zoned, side, w, near[n], book)
        if place < 0:
            return place
        _follow_swap(zoned, w, near[n], changed, book)
        changed += 1


@inlined_kernel
def _follow_swap(
    zoned: ZoneState, w: int, near: np.void, changed: int, book: BorderRecords
) -> None:
    """Update the recorded row of a vehicle that entered the zone `near["source"]` in this tick.

    If a vehicle leaves a zone, the last row of the zone moves into its place. Without the update,
    `release` would search all rows.
    """
    last = zoned.num_owned[near["source"], w]
    newest = book.num_changes[w] - 1
    for n in range(newest - changed, newest):
        change = book.changes[w, n]
        if change["target"] == near["source"] and change["place"] == last:
            change["place"] = near["row"]


@inlined_kernel
def _is_newborn(book: BorderRecords, w: int, num_newborn: int, vehicle: int) -> bool:
    for n in range(num_newborn):
        if book.newborn[w, n] == vehicle:
            return True
    return False


@inlined_kernel
def _renew(zoned: ZoneState, side: int, w: int, book: BorderRecords) -> None:
    """Write the current list in `coming`; vehicles of the previous list keep their approach."""
    turn = book.turn[w]
    before = book.coming[w, 1 - turn]
    now = book.coming[w, turn]
    num_before = book.num_coming[w, 1 - turn]
    known = 0
    for n in range(book.num_near[w]):
        near = book.near[w, n]
        entry = now[n]
        epoch = zoned.rows[side, near["source"], w, near["row"]]["epoch"]
        entry["vehicle"] = near["vehicle"]
        entry["target"] = near["target"]
        entry["epoch"] = epoch
        k = _place_of(before, num_before, near["vehicle"], near["target"], epoch)
        if k >= 0:
            entry["tick"] = before[k]["tick"]
            entry["depth_m"] = before[k]["depth_m"]
            entry["ms"] = before[k]["ms"]
            known += 1
        else:
            entry["tick"] = book.tick[w]
            entry["depth_m"] = near["depth_m"]
            entry["ms"] = book.ms[w]
    book.num_coming[w, turn] = book.num_near[w]
    book.known[w] = known


@inlined_kernel
def _place_of(coming: NDArray[np.void], num: int, vehicle: int, target: int, epoch: int) -> int:
    """Return the index of the entry in `coming[:num]`, or -1."""
    for k in range(num):
        entry = coming[k]
        if entry["vehicle"] == vehicle and entry["target"] == target and entry["epoch"] == epoch:
            return k
    return -1


@inlined_kernel
def _next_crossed(near: NDArray[np.void], num: int, last: int) -> int:
    """Return the entry of the crossed vehicle with the smallest id above `last`, or -1."""
    best = -1
    for n in range(num):
        entry = near[n]
        if (
            entry["crossed"]
            and entry["vehicle"] > last
            and (best < 0 or entry["vehicle"] < near[best]["vehicle"])
        ):
            best = n
    return best


@kernel
def _change(zoned: ZoneState, side: int, w: int, near: np.void, book: BorderRecords) -> int:
    """Change the owner of a vehicle that has crossed. Return the result of `pass_on`."""
    vehicle = near["vehicle"]
    target = near["target"]
    turn = book.turn[w]
    coming = book.coming[w, turn]
    k = 0
    while coming[k]["vehicle"] != vehicle or coming[k]["target"] != target:
        k += 1
    epoch = coming[k]["epoch"] + 1
    change = book.changes[w, book.num_changes[w]]
    change["tick"] = book.tick[w] + 1
    change["vehicle"] = vehicle
    change["source"] = near["source"]
    change["target"] = target
    change["epoch"] = epoch
    change["approached"] = coming[k]["tick"]
    change["prepare_depth_m"] = coming[k]["depth_m"]
    change["switch_depth_m"] = near["depth_m"]
    change["release_depth_m"] = math.nan
    change["ms"] = coming[k]["ms"]
    place = pass_on(vehicle, near["source"], near["row"], target, epoch, zoned, side, w)
    change["place"] = place
    if place >= 0:
        book.num_changes[w] += 1
        book.num_coming[w, turn] -= 1
        coming[k] = coming[book.num_coming[w, turn]]
    return place


@kernel
def release(
    zones: ZoneArrays,
    zoned: ZoneState,  # the rows of all zones
    side: int,  # the buffer of rows, 0 or 1
    w: int,
    changed: int,  # number of the newest changes
    now_ms: float,  # clock time
    book: BorderRecords,  # output: `changes`
) -> None:
    """Complete the newest changes at the end of their tick: duration and distance to the source."""
    last = book.num_changes[w]
    for n in range(last - changed, last):
        change = book.changes[w, n]
        change["ms"] = now_ms - change["ms"]
        target = change["target"]
        rows = zoned.rows[side, target, w]
        owned = zoned.num_owned[target, w]
        i = change["place"]
        if i >= owned or rows[i]["id"] != change["vehicle"]:
            i = 0
            while i < owned and rows[i]["id"] != change["vehicle"]:
                i += 1
        if i < owned:
            squared = squared_distance(zones.rects, change["source"], rows[i]["x"], rows[i]["y"])
            change["release_depth_m"] = math.sqrt(squared)
