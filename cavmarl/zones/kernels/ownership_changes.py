"""Changes of owner where all zones share a process: approaches to a border, and changes.

Both are kept in a `BorderRecords`. Vehicles that come near are noted at the end of a tick, with
the ghosts;
in most ticks none has crossed, and nothing is to be done when the next one begins.
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

# What `hand_over` returns where it cannot go on, as `pass_on` does.
NOT_OWNED = -1
NOT_SEEN = -2

COMING = np.dtype(
    [
        ("vehicle", np.int64),
        ("target", np.int64),  # zone that it comes near to
        ("epoch", np.int64),  # of its present ownership
        ("tick", np.int64),  # in which it was near first
        ("depth_m", np.float64),  # how far outside of its owner's zone it was then, see NEAR
        ("ms", np.float64),  # of the clock, then
    ],
    align=True,
)

CHANGE = np.dtype(
    [
        ("tick", np.int64),  # that the new owner computes first
        ("vehicle", np.int64),
        ("source", np.int64),
        ("target", np.int64),
        ("epoch", np.int64),  # the new one
        ("place", np.int64),  # its row at the target
        ("approached", np.int64),  # tick in which it was near first
        ("prepare_depth_m", np.float64),  # how far outside of the source's zone it was then,
        ("switch_depth_m", np.float64),  # when it changed,
        ("release_depth_m", np.float64),  # and one tick later; NaN: it has left the world
        (
            "ms",
            np.float64,
        ),  # since it was near first, or, until its tick is over, of the clock then
    ],
    align=True,
)


DUE = np.dtype(
    [
        ("row", np.int32),  # of its owner
        ("zone", np.int32),  # that needs it
        ("near", np.bool_),  # it can touch a vehicle there
        ("at_border", np.bool_),  # of that zone
    ],
    align=True,
)
"""A row that is to be sent to a zone as a ghost."""

AT_ONCE = 512
"""So many are found before they are sent; more than there can be zones."""

LATE = 256
"""Once so many changes wait they are read; the last tick may add one for each vehicle."""


class BorderRecords(NamedTuple):
    """What is known of the borders of W worlds; C rows a zone can hold."""

    near: NDArray[np.void]  # NEAR (W, 2 C) by the newest rows
    num_near: NDArray[np.int64]  # (W,)
    num_crossed: NDArray[np.int64]  # (W,) of them
    owned: NDArray[np.int64]  # (W,) vehicles, when `near` was made
    coming: NDArray[np.void]  # COMING (W, 2, 2 C) near and not changed; two, swapped each tick
    turn: NDArray[np.int64]  # (W,) which of `coming` is the present one, the other the one before
    num_coming: NDArray[np.int64]  # (W, 2)
    known: NDArray[np.int64]  # (W,) of the present ones, those that were so before
    acknowledged: NDArray[np.int64]  # (W,) entries of `coming`, in all ticks before this one
    aborted: NDArray[np.int64]  # (W,) of them that have turned away or left
    tick: NDArray[np.int64]  # (W,) whose rows have been looked at
    ms: NDArray[np.float64]  # (W,) of a clock, when it began
    newborn: NDArray[np.int64]  # (W, C) ids that have entered since the last tick began
    changes: NDArray[np.void]  # CHANGE (W, C + LATE) those not read yet
    num_changes: NDArray[np.int64]  # (W,)
    due: NDArray[np.void]  # DUE (AT_ONCE,) scratch of `exchange`


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
        changes=np.zeros((num_worlds, capacity + LATE), CHANGE),
        num_changes=numbers(),
        due=np.zeros(AT_ONCE, DUE),
    )


@kernel
def look(
    zones: ZoneArrays,
    borders: Borders,  # when a vehicle is near one
    zoned: ZoneState,  # the rows of all zones
    side: int,  # whose rows, 0 or 1
    w: int,
    everybody: bool,  # whether to look at all owned rows, see `find_near`
    num_newborn: int,  # `book.newborn[w, :num_newborn]` stay where they are
    book: BorderRecords,  # `near` and `coming` are written
) -> None:
    """Note vehicles near a border, and those of them that have crossed it."""
    near = book.near[w]
    found = find_near(zones, borders, zoned, side, w, everybody, near)
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
    """`look` at the rows of the next tick."""
    now = book.turn[w]
    book.tick[w] += 1
    book.acknowledged[w] += book.num_near[w]
    book.aborted[w] += book.num_coming[w, 1 - now] - book.known[w]
    book.turn[w] = 1 - now
    look(zones, borders, zoned, side, w, False, 0, book)


@kernel
def hand_over(
    zones: ZoneArrays,
    borders: Borders,  # when a vehicle is near one
    zoned: ZoneState,  # the rows of all zones
    side: int,  # whose rows, 0 or 1
    w: int,
    everybody: bool,  # whether rows have changed since `look_on`
    num_newborn: int,  # see `look`
    book: BorderRecords,  # written
) -> int:
    """Give every vehicle that lies beyond its zone's hysteresis to the zone that it is in.

    Returns:
        how many have changed, by rising ids at the end of `book.changes`; or NOT_OWNED or NOT_SEEN,
        with the vehicle concerned behind them.
    """
    if everybody:
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
    """The last to enter a zone fills the row of one that leaves it in the same tick.

    Without this `release` would look for it among all rows.
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
    """Let the present `coming` be the vehicles near now; known ones keep what is known of them."""
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
    """Index of the entry in `coming[:num]`, or -1."""
    for k in range(num):
        entry = coming[k]
        if entry["vehicle"] == vehicle and entry["target"] == target and entry["epoch"] == epoch:
            return k
    return -1


@inlined_kernel
def _next_crossed(near: NDArray[np.void], num: int, last: int) -> int:
    """The entry of the smallest id above `last` that has crossed, or -1."""
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
    """Let a vehicle that has crossed change its owner; its new row, or why it has none."""
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
    side: int,  # whose rows, 0 or 1
    w: int,
    changed: int,  # how many there are of them
    now_ms: float,  # of a clock
    book: BorderRecords,  # `changes` is written
) -> None:
    """Note when the tick of the newest changes ends, and how far from their old zone they are."""
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
