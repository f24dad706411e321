"""Lookup of the zone of a position, and of the zones that must see a vehicle at the position.

A zone is a rectangle [min_x, max_x) by [min_y, max_y); zones at the rim extend to infinity. The
cuts of all zones form a table of cells, each of which belongs to one zone. Two searches among the
cuts find the cell of a position. They only compare the coordinates with stored numbers, so all
processes agree, even for positions on a border.

Ghosts depend on a vehicle's position: a zone receives a ghost of the vehicle if the vehicle is
within the zone's halo and a driver of the zone may consider it. The zone need not touch the
vehicle's own zone (decision 012).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.codes import DRIVER_BACKGROUND
from cavmarl.core.records.rows import MERGES_M
from cavmarl.driving.kernels.junctions.stop_line_registration import (
    can_be_ignored,
    registration_distance_m,
)


class ZoneArrays(NamedTuple):
    """The arrays of a `ZonePartition` of k zones, for kernels."""

    cuts_x: NDArray[np.float64]  # (columns - 1,) ascending, m
    cuts_y: NDArray[np.float64]  # (rows - 1,) ascending, m
    cells: NDArray[np.int32]  # (rows, columns) the zone of each cell
    rects: NDArray[np.float64]  # (k, 4) min_x, min_y, max_x, max_y; infinite at the rim


LOOK = np.dtype([(name, np.float32) for name in ("head", "tail", "back", "line", "room", "merge")])
"""The vehicles on a lane that a zone's drivers may consider (`kernels.visibility_tests`), by their
position in m along the lane: vehicles up to `head`, vehicles beyond `tail`, and vehicles within
their registration distance of one of three places. These are `back`, the position of a vehicle that
drivers may follow; `line`, a stop line, except for vehicles that may be ignored before the line;
and `room`, a stop line before which no vehicle may be ignored. Moving vehicles are also considered
within `MERGES_M` of `merge`, a line at which other vehicles turn into their lane."""

WATCH = np.dtype([("zone", np.int32), *((name, LOOK[name]) for name in LOOK.names or ())])
"""A LOOK and its zone."""


OUTER = np.dtype(
    [
        ("x", np.float64),
        ("y", np.float64),
        ("s", np.float64),
        ("speed", np.float64),
        ("row", np.int32),  # VEHICLE row
        ("lane", np.int32),
        ("driver", np.int32),
        ("hold", np.int32),
        ("wait_s", np.float64),
    ],
    align=True,
)
"""The fields of an owned row that decide which zones must see it. They are copied right after the
row is written, because rows are large and these fields are far apart in memory."""


class Halo(NamedTuple):
    """How far zones see beyond their borders, and which vehicles they see."""

    halo_m: float
    inner: NDArray[np.float64]  # (k, 4) the part of a zone in which no other zone sees vehicles
    near_start: NDArray[np.int32]  # (k + 1,)
    # near[near_start[z] : near_start[z + 1]]: zones within the halo of zone z, including z
    near: NDArray[np.int32]
    sure_m: float  # all vehicles within this distance are seen
    seen_m: float  # from `sure_m` to this distance, only vehicles in `watchers` are seen
    line_m: float  # a vehicle whose centre is farther before a line has not reached the line
    watcher_start: NDArray[np.int32]  # (L + 1,); (1,) without watchers: sure_m equals seen_m
    # WATCH: watchers[watcher_start[l] : watcher_start[l + 1]] are the zones that may see vehicles
    # on lane l, and the vehicles that they see
    watchers: NDArray[np.void]


@kernel
def _slot(cuts: NDArray[np.float64], value: float) -> int:
    """Return the number of cuts at or below `value`; 0 for NaN."""
    low = 0
    high = cuts.size
    while low < high:
        middle = (low + high) >> 1
        if cuts[middle] <= value:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def zone_of(zones: ZoneArrays, x: float, y: float) -> int:
    """Return the zone of a position in metres, in O(log k).

    A position on a border belongs to the zone that begins at the border.
    """
    return int(zones.cells[_slot(zones.cuts_y, y), _slot(zones.cuts_x, x)])


@kernel
def zones_of(
    zones: ZoneArrays,
    rows: NDArray[np.void],  # records with `x` and `y` in metres, such as VEHICLE
    num: int,  # number of rows to look up, `rows[:num]`
    out: NDArray[np.int32],  # (num,) or longer, output
) -> None:
    """Write the zone of each row's position; see `zone_of`."""
    for i in range(num):
        out[i] = zone_of(zones, rows[i]["x"], rows[i]["y"])


@inlined_kernel
def is_inside(rect: NDArray[np.float64], x: float, y: float) -> bool:
    """Return whether a position is within a rectangle and not on its rim."""
    inside: bool = rect[0] < x and x < rect[2] and rect[1] < y and y < rect[3]
    return inside


@inlined_kernel
def squared_distance(rects: NDArray[np.float64], zone: int, x: float, y: float) -> float:
    """Return the squared distance in m² from a position to the nearest point of a zone; 0 inside.

    Rounding is monotonic. So the squared distance from (x, y) to any vehicle inside the zone,
    computed with the same operations, is at least as large, without any rounding error.
    """
    # On each axis, at most one difference is positive, so no branch is needed.
    dx = max(rects[zone, 0] - x, x - rects[zone, 2], 0.0)
    dy = max(rects[zone, 1] - y, y - rects[zone, 3], 0.0)
    return float(dx * dx + dy * dy)


@inlined_kernel
def note_outer(outer: np.void, row: np.void, i: int) -> None:
    """Record VEHICLE row i, which other zones may have to see."""
    outer["x"] = row["x"]
    outer["y"] = row["y"]
    outer["s"] = row["s"]
    outer["speed"] = row["speed"]
    outer["row"] = i
    outer["lane"] = row["lane"]
    outer["driver"] = row["driver"]
    outer["hold"] = row["hold"]
    outer["wait_s"] = row["wait_s"]


@inlined_kernel
def may_be_considered(halo: Halo, watch: np.void, row: np.void) -> bool:
    """Return whether a driver of a zone that watches a vehicle's lane may consider the vehicle."""
    # Branches would be unpredictable, and would cost more than the work that they save.
    s = row["s"]
    reach_m = registration_distance_m(row["speed"])
    to_line = watch["line"] - s
    stands = can_be_ignored(row)
    is_let = (row["driver"] == DRIVER_BACKGROUND) & stands & (to_line > halo.line_m)
    comes = (to_line < reach_m) & (not is_let)
    merges = (watch["merge"] - s < MERGES_M) & (not stands)
    follows = watch["back"] - s < reach_m
    swept = watch["room"] - s < reach_m  # drivers leave room even for vehicles they may ignore
    considered: bool = (
        (s <= watch["head"]) | (s >= watch["tail"]) | follows | comes | merges | swept
    )
    return considered


@inlined_kernel
def is_seen(
    halo: Halo,
    zone: int,
    row: np.void,  # VEHICLE or OUTER
    squared: float,  # m², the `squared_distance` of the row from the zone
) -> bool:
    """Return whether a zone must see a vehicle."""
    if not squared <= halo.seen_m * halo.seen_m:  # also false for NaN
        return False
    if squared <= halo.sure_m * halo.sure_m:
        return True
    for k in range(halo.watcher_start[row["lane"]], halo.watcher_start[row["lane"] + 1]):
        if halo.watchers[k]["zone"] == zone:
            return may_be_considered(halo, halo.watchers[k], row)
    return False
