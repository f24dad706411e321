"""Vehicles at the borders of zones: crossings, past and near, and how rows change hands."""

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
        ("source", np.int64),  # zone that owns it
        ("row", np.int64),  # where the owner keeps it
        ("target", np.int64),  # zone that it is in, or will be in
        ("crossed", np.bool_),  # it is further than the hysteresis outside of its owner's zone
        ("depth_m", np.float64),  # how far outside of its owner's zone; inside, less than 0: how
        # far it has to go to the target
    ],
    align=True,
)


class Borders(NamedTuple):
    """When a vehicle is near a border, and when behind it."""

    hysteresis_m: float  # so far outside of its zone a vehicle still stays with it
    ahead_s: float  # near a border: behind it after this time, at its velocity
    max_speed_mps: float  # which no vehicle exceeds


@kernel
def find_near(
    zones: ZoneArrays,
    borders: Borders,  # when a vehicle is near one
    zoned: ZoneState,  # the rows of all zones
    side: int,  # whose rows, 0 or 1
    w: int,
    # whether to look at all owned rows, and not only at those that `exchange` has found near a
    # border
    everybody: bool,
    # NEAR (2 C,) overwritten: by zones and rows, a crossing before an approach
    out: NDArray[np.void],
) -> int:
    """The owned rows that other zones have to be told of; how many entries there are.

    A vehicle is near a zone that it lies in, further than the hysteresis outside of its own, and
    one that it would lie in so after `ahead_s` at its present velocity.
    """
    found = 0
    for zone in range(zones.rects.shape[0]):
        owned = zoned.num_owned[zone, w]
        for n in range(owned if everybody else zoned.num_border[zone, w]):
            i = n if everybody else zoned.border[zone, w, n]
            if i < owned:
                row = zoned.rows[side, zone, w, i]
                found = _tell_of(zones, borders, row, zone, i, out, found)
    return found


@inlined_kernel
def _tell_of(
    zones: ZoneArrays,
    borders: Borders,
    row: np.void,
    zone: int,
    i: int,
    out: NDArray[np.void],
    found: int,
) -> int:
    """Note row i of a zone once for each zone that it is near to; how many entries there are."""
    rects = zones.rects
    x = row["x"]
    y = row["y"]
    # Vehicles further inside cannot come out in that time. Infinite rims stay infinite.
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
    source: int,  # the zone that owns it
    row: int,  # where it probably is there
    target: int,  # the zone that will own it
    epoch: int,  # from then on
    zoned: ZoneState,  # the rows of all zones, and how many they are
    side: int,  # whose rows, 0 or 1
    w: int,
) -> int:
    """Make a vehicle a ghost of the zone that owned it, and an owned row where it was a ghost.

    The new row says what the old one does, but for its owner and epoch.

    Returns:
        its row at the target; -1: the source does not own it; -2: the target has no ghost of it.
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
    """Make a vehicle that a zone owns one of its ghosts; whether it did own it."""
    row = _owned_row(vehicle, source, row, zoned, side, w)
    if row < 0:
        return False
    last = zoned.num_owned[source, w] - 1
    _swap(zoned.rows[side, source, w], row, last, zoned.spare)
    zoned.num_owned[source, w] = last
    return True


@kernel
def take_over(vehicle: int, target: int, epoch: int, zoned: ZoneState, side: int, w: int) -> int:
    """Make a ghost of a zone a row that it owns, at an epoch: where it is; -1: it has none."""
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
    """Where a zone keeps a vehicle that it owns, probably at `hint`; -1: it does not own it."""
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
