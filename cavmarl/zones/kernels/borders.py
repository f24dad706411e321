"""Vehicles near the borders of zones: search for crossings, and changes of owner."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import cosine, sine
from cavmarl.core.records.arrays import ZoneState
from cavmarl.zones.kernels.zone_lookup import ZoneArrays, squared_distance, zone_of

NEAR = np.dtype(
    [
        ("vehicle", np.int64),
        ("source", np.int64),  # zone that owns the vehicle
        ("row", np.int64),  # index of its row in this zone
        ("target", np.int64),  # zone that contains the vehicle now or soon
        ("crossed", np.bool_),  # whether it is in `target` now, beyond the hysteresis
        ("depth_m", np.float64),  # distance outside of the source zone; inside, the negative
        # distance to the target zone
    ],
    align=True,
)


class Borders(NamedTuple):
    """The rules for when a vehicle is near a border, and when it has crossed it."""

    hysteresis_m: float  # a vehicle keeps its owner up to this distance outside of the owner's zone
    ahead_s: float  # a vehicle is near a border if it will cross the border within this time
    max_speed_mps: float  # upper bound of the speed of vehicles


@kernel
def find_near(
    zones: ZoneArrays,
    borders: Borders,
    zoned: ZoneState,  # the rows of all zones
    side: int,  # the buffer of rows, 0 or 1
    w: int,
    # whether to check all owned rows; if not, only rows that `exchange` has found near a border
    check_all: bool,
    # NEAR (2 C,) is written, in the order of zones and rows; a crossing precedes an approach
    out: NDArray[np.void],
) -> int:  # number of entries
    """Find owned vehicles that have crossed a border or are near a border.

    A vehicle has crossed a border if it is farther than the hysteresis outside of its owner's zone.
    It is near a zone if it would have crossed into that zone after `ahead_s` at its current
    velocity.
    """
    found = 0
    for zone in range(zones.rects.shape[0]):
        owned = zoned.num_owned[zone, w]
        for n in range(owned if check_all else zoned.num_border[zone, w]):
            i = n if check_all else zoned.border[zone, w, n]
            if i < owned:
                row = zoned.rows[side, zone, w, i]
                found = _add_near(zones, borders, row, zone, i, out, found)
    return found


@inlined_kernel
def _add_near(
    zones: ZoneArrays,
    borders: Borders,
    row: np.void,
    zone: int,
    i: int,
    out: NDArray[np.void],
    found: int,
) -> int:
    """Append row i of a zone for each other zone that it is in or near. Return the new count."""
    rects = zones.rects
    x = row["x"]
    y = row["y"]
    # Vehicles farther inside cannot leave the zone within `ahead_s`. Infinite rims stay infinite.
    margin = borders.max_speed_mps * borders.ahead_s
    if (
        rects[zone, 0] + margin < x
        and x < rects[zone, 2] - margin
        and rects[zone, 1] + margin < y
        and y < rects[zone, 3] - margin
    ):
        return found
    limit = borders.hysteresis_m * borders.hysteresis_m
    squared = squared_distance(rects, zone, x, y)
    here = zone
    if squared > limit:
        here = zone_of(zones, x, y)
        _note(out[found], row["id"], zone, i, here, True, squared)
        found += 1
    way = row["speed"] * borders.ahead_s
    then_x = x + cosine(row["heading"]) * way
    then_y = y + sine(row["heading"]) * way
    if squared_distance(rects, zone, then_x, then_y) > limit:
        there = zone_of(zones, then_x, then_y)
        if there != here:
            if squared == 0.0:
                squared = -squared_distance(rects, there, x, y)
            _note(out[found], row["id"], zone, i, there, False, squared)
            found += 1
    return found


@inlined_kernel
def _note(
    entry: np.void, vehicle: int, source: int, row: int, target: int, crossed: bool, squared: float
) -> None:
    entry["vehicle"] = vehicle
    entry["source"] = source
    entry["row"] = row
    entry["target"] = target
    entry["crossed"] = crossed
    entry["depth_m"] = math.copysign(math.sqrt(abs(squared)), squared)


@kernel
def pass_on(
    vehicle: int,
    source: int,  # the current owner
    row: int,  # the vehicle's probable row in the source zone
    target: int,  # the next owner
    epoch: int,  # epoch of the new ownership
    zoned: ZoneState,  # the rows of all zones and their numbers
    side: int,  # the buffer of rows, 0 or 1
    w: int,
) -> int:
    """Change a vehicle's owner: the old row becomes a ghost, and the target's ghost becomes a row.

    The new row is a copy of the old row; only its owner and its epoch differ.

    Returns:
        The vehicle's row at the target; -1 if the source does not own the vehicle; -2 if the target
        has no ghost of the vehicle.
    """
    row = _owned_row(vehicle, source, row, zoned, side, w)
    if row < 0:
        return -1
    place = take_over(vehicle, target, epoch, zoned, side, w)
    if place < 0:
        return -2
    new = zoned.rows[side, target, w]
    new[place] = zoned.rows[side, source, w, row]
    new[place]["owner"] = target
    new[place]["epoch"] = epoch
    give_up(vehicle, source, row, zoned, side, w)
    return place


@kernel
def give_up(vehicle: int, source: int, row: int, zoned: ZoneState, side: int, w: int) -> bool:
    """Make an owned vehicle of a zone a ghost. Return whether the zone owned it."""
    row = _owned_row(vehicle, source, row, zoned, side, w)
    if row < 0:
        return False
    last = zoned.num_owned[source, w] - 1
    _swap(zoned.rows[side, source, w], row, last, zoned.spare)
    zoned.num_owned[source, w] = last
    return True


@kernel
def take_over(vehicle: int, target: int, epoch: int, zoned: ZoneState, side: int, w: int) -> int:
    """Make a ghost of a zone an owned row. Return the row; -1 if there is no such ghost."""
    rows = zoned.rows[side, target, w]
    place = zoned.num_owned[target, w]
    ghost = place
    while ghost < zoned.num_rows[target, w] and rows[ghost]["id"] != vehicle:
        ghost += 1
    if ghost == zoned.num_rows[target, w]:
        return -1
    _swap(rows, ghost, place, zoned.spare)
    rows[place]["owner"] = target
    rows[place]["epoch"] = epoch
    zoned.num_owned[target, w] = place + 1
    return int(place)


@inlined_kernel
def _owned_row(vehicle: int, zone: int, hint: int, zoned: ZoneState, side: int, w: int) -> int:
    """Return the row of a zone's owned vehicle, probably `hint`; -1 if the zone does not own it."""
    rows = zoned.rows[side, zone, w]
    owned = zoned.num_owned[zone, w]
    found = hint
    if hint >= owned or rows[hint]["id"] != vehicle:
        found = 0
        while found < owned and rows[found]["id"] != vehicle:
            found += 1
        if found == owned:
            found = -1
    return found


@inlined_kernel
def _swap(rows: NDArray[np.void], i: int, j: int, spare: NDArray[np.void]) -> None:
    if i != j:
        spare[0] = rows[i]
        rows[i] = rows[j]
        rows[j] = spare[0]
