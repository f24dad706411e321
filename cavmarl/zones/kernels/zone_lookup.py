"""Which zone a place belongs to, and which other zones have to see what is there.

A zone is a rectangle [min_x, max_x) by [min_y, max_y); those at the rim reach to infinity. The cuts
of all zones together span a table of cells, each of one zone: a place belongs to the cell that two
searches among the cuts find. Both only compare the coordinate with stored numbers, so every process
gives the same answer, on a border as well.

A vehicle is published by its position: each zone within the halo of it gets it as a ghost, whether
or not that zone touches the vehicle's own (decision 012), if a driver there may ask about it.
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
    """What kernels take of a `ZonePartition`; k zones."""

    cuts_x: NDArray[np.float64]  # (columns - 1,) rising, m
    cuts_y: NDArray[np.float64]  # (rows - 1,) rising, m
    cells: NDArray[np.int32]  # (rows, columns) the zone of each cell
    rects: NDArray[np.float64]  # (k, 4) min_x, min_y, max_x, max_y; infinite at the rim


LOOK = np.dtype([(name, np.float32) for name in ("head", "tail", "back", "line", "room", "merge")])
"""Vehicles that a zone's drivers may ask about on a lane: those up to `head` m, those from `tail` m
on, and those that announce themselves to a vehicle at `back` m that they follow, or to a line: at
`line` m unless they are let stand before it, at `room` m even then (`kernels.visibility_tests`).
To a line at `merge` m, where others turn into their lane, they do so `MERGES_M` ahead at least."""

WATCH = np.dtype([("zone", np.int32), *((name, LOOK[name]) for name in LOOK.names or ())])
"""A LOOK, and whose it is."""


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
"""What says of an owned row which zones have to see it. It is noted when the row has just been
written: rows are large, and those that matter here lie far apart in memory."""


class Halo(NamedTuple):
    """How far zones see over their borders, and which vehicles."""

    halo_m: float
    inner: NDArray[np.float64]  # (k, 4) the part of a zone in which no other zone sees any
    near_start: NDArray[np.int32]  # (k + 1,)
    near: NDArray[np.int32]  # near[near_start[z] : near_start[z + 1]]: zones within the halo of
    # zone z, z itself among them
    sure_m: float  # all vehicles within this distance are seen, further away those
    seen_m: float  # that drivers may ask about, and beyond this none, since roads lead no further
    line_m: float  # whose centre is further than this before a line has not reached it
    watcher_start: NDArray[np.int32]  # (L + 1,); (1,) if sure_m is seen_m, so that there are none
    watchers: NDArray[np.void]  # WATCH: watchers[watcher_start[l] : watcher_start[l + 1]] are those
    # zones that may see vehicles on lane l, and which of them


@kernel
def _slot(cuts: NDArray[np.float64], value: float) -> int:
    """How many of the cuts are at or below `value`; none for NaN."""
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
    """The one zone of a place in metres; a place on a border belongs to the zone that begins there.

    O(log k).
    """
    return int(zones.cells[_slot(zones.cuts_y, y), _slot(zones.cuts_x, x)])


@kernel
def zones_of(
    zones: ZoneArrays,
    rows: NDArray[np.void],  # records with `x` and `y` in metres, such as VEHICLE
    num: int,  # how many of them, `rows[:num]`
    out: NDArray[np.int32],  # (num,) or longer, overwritten
) -> None:
    """`zone_of` for many."""
    for i in range(num):
        out[i] = zone_of(zones, rows[i]["x"], rows[i]["y"])


@inlined_kernel
def is_inside(rect: NDArray[np.float64], x: float, y: float) -> bool:
    """Whether a place is within a rectangle and not on its rim."""
    inside: bool = rect[0] < x and x < rect[2] and rect[1] < y and y < rect[3]
    return inside


@inlined_kernel
def squared_distance(rects: NDArray[np.float64], zone: int, x: float, y: float) -> float:
    """From a place to the nearest point of a zone, squared, in m²; 0 inside.

    Rounding grows with what is rounded. So the squared distance from (x, y) to a vehicle inside the
    zone, taken by the same operations, is never the smaller of the two: not by one bit.
    """
    # One of the two is negative, and both are inside: no branch has to be guessed.
    dx = max(rects[zone, 0] - x, x - rects[zone, 2], 0.0)
    dy = max(rects[zone, 1] - y, y - rects[zone, 3], 0.0)
    return float(dx * dx + dy * dy)


@inlined_kernel
def note_outer(outer: np.void, row: np.void, i: int) -> None:
    """Note VEHICLE row i as one that other zones may have to see."""
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
def is_asked_about(halo: Halo, watch: np.void, row: np.void) -> bool:
    """Whether some driver of a zone that watches a vehicle's lane may ask about it."""
    # Answers are unpredictable: branches would cost more than all that they leave out.
    s = row["s"]
    reach_m = registration_distance_m(row["speed"])
    to_line = watch["line"] - s
    stands = can_be_ignored(row)
    is_let = (row["driver"] == DRIVER_BACKGROUND) & stands & (to_line > halo.line_m)
    comes = (to_line < reach_m) & (not is_let)
    merges = (watch["merge"] - s < MERGES_M) & (not stands)
    follows = watch["back"] - s < reach_m
    swept = watch["room"] - s < reach_m  # one that waits leaves it room, even where it is let stand
    asked: bool = (s <= watch["head"]) | (s >= watch["tail"]) | follows | comes | merges | swept
    return asked


@inlined_kernel
def is_seen(
    halo: Halo,
    zone: int,  # that sees, or not
    row: np.void,  # VEHICLE or OUTER
    squared: float,  # m²
) -> bool:
    """Whether a zone has to see a vehicle whose `squared_distance` from it is known."""
    if not squared <= halo.seen_m * halo.seen_m:  # nor where it is nowhere
        return False
    if squared <= halo.sure_m * halo.sure_m:
        return True
    for k in range(halo.watcher_start[row["lane"]], halo.watcher_start[row["lane"] + 1]):
        if halo.watchers[k]["zone"] == zone:
            return is_asked_about(halo, halo.watchers[k], row)
    return False
