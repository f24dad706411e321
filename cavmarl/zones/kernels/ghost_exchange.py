"""The exchange of ghosts between shards in each tick.

In a shard's rows, owned rows come first and ghosts after them. `exchange` renews the ghosts of all
zones: each zone publishes its rows. If several processes run the zones, each process calls `gather`
for its zones, and then one process calls `note_gathered`. Both ways give the same rows in the same
order, but `gather` reads all zones, near or far.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.compiled.prefetch import SOON, prefetch
from cavmarl.core.records.arrays import ZoneState
from cavmarl.core.records.codes import DRIVER_BACKGROUND
from cavmarl.zones.kernels.borders import Borders
from cavmarl.zones.kernels.ownership_changes import BorderRecords, look_on
from cavmarl.zones.kernels.zone_lookup import (
    Halo,
    ZoneArrays,
    is_inside,
    is_seen,
    may_be_considered,
    note_outer,
    squared_distance,
    zone_of,
)

ROW_LINES = 6  # cache lines of a VEHICLE row


@kernel
def exchange(
    zones: ZoneArrays,
    halo: Halo,  # from `partition.zone_halo.zone_halo`, for the same partition
    touching_m: float,  # a ghost farther outside of a zone cannot touch a vehicle of the zone
    borders: Borders,
    # outputs: ghosts, their numbers, border and num_border. Only rows in the list `outer`, which
    # other zones may have to see, are read; if the list is missing, it is made here
    zoned: ZoneState,
    side: int,  # the buffer of rows, 0 or 1
    first: int,  # the first world
    last: int,  # number after the last world
    book: BorderRecords,  # output: vehicles near a border
) -> None:
    """Renew all ghosts of some worlds from the owned rows, and record vehicles near a border.

    A zone needs a vehicle if and only if a driver in the zone may consider it; see
    `visibility_tests.find_looks`. If a late transfer leaves a vehicle outside of its owner's zone,
    the vehicle is published as usual, even to the zone that contains it.
    """
    # A vehicle at a greater distance cannot cross the border within `ahead_s`.
    border_m = borders.max_speed_mps * borders.ahead_s
    count = zones.rects.shape[0]
    for w in range(first, last):
        for zone in range(count):
            owned = zoned.num_owned[zone, w]
            zoned.num_rows[zone, w] = owned
            zoned.num_near[zone, w] = owned
        if count > 1:
            for zone in range(count):
                _publish(zones, halo, touching_m, border_m, zoned, side, zone, w, book.due)
        look_on(zones, borders, zoned, side, w, book)


@kernel
def gather(
    zones: ZoneArrays,
    halo: Halo,  # as for `exchange`
    touching_m: float,  # as for `exchange`
    border_m: float,  # an owned row within this distance of another zone is at a border, m
    # outputs: the ghosts of this zone and their number, its border and num_border, but not outer
    # and num_outer
    zoned: ZoneState,
    side: int,  # the buffer of rows, 0 or 1
    zone: int,  # the zone that gathers
    w: int,
) -> None:
    """Renew the ghosts of one zone from the owned rows of all other zones; record rows at borders.

    Calls for different zones may run at the same time: a call writes only the state of its zone,
    and reads only state that no call writes.
    """
    near_limit = touching_m * touching_m
    border_limit = min(halo.halo_m * halo.halo_m, border_m * border_m)
    count = zones.rects.shape[0]
    zoned.num_rows[zone, w] = zoned.num_owned[zone, w]
    zoned.num_near[zone, w] = zoned.num_owned[zone, w]
    for source in range(count):
        if source == zone:
            continue
        noted = zoned.num_outer[source, w]
        for n in range(noted):
            outer = zoned.outer[source, w, n]
            squared = squared_distance(zones.rects, zone, outer["x"], outer["y"])
            if is_seen(halo, zone, outer, squared):
                near = squared <= near_limit
                _take_ghost(zoned, side, source, outer["row"], zone, w, near)
        for i in range(zoned.num_owned[source, w] if noted < 0 else 0):
            row = zoned.rows[side, source, w, i]
            squared = squared_distance(zones.rects, zone, row["x"], row["y"])
            if is_seen(halo, zone, row, squared):
                _take_ghost(zoned, side, source, i, zone, w, squared <= near_limit)
    found = 0
    noted = zoned.num_outer[zone, w]
    for n in range(noted if noted >= 0 else zoned.num_owned[zone, w]):
        i = n
        x = zoned.outer[zone, w, n]["x"]
        y = zoned.outer[zone, w, n]["y"]
        if noted >= 0:
            i = zoned.outer[zone, w, n]["row"]
        else:
            x = zoned.rows[side, zone, w, i]["x"]
            y = zoned.rows[side, zone, w, i]["y"]
        for other in range(count):
            if other != zone and squared_distance(zones.rects, other, x, y) <= border_limit:
                zoned.border[zone, w, found] = i
                found += 1
                break
    zoned.num_border[zone, w] = found


@kernel
def note_gathered(
    zones: ZoneArrays,
    borders: Borders,
    zoned: ZoneState,  # num_outer is reset, since rows may change afterwards
    side: int,  # the buffer of rows, 0 or 1
    book: BorderRecords,  # output: vehicles near a border
) -> None:
    """Record vehicles near a border, as `exchange` does, after all zones have gathered ghosts."""
    for w in range(zoned.num_outer.shape[1]):
        for zone in range(zones.rects.shape[0]):
            zoned.num_outer[zone, w] = -1
        look_on(zones, borders, zoned, side, w, book)


@inlined_kernel
def _publish(
    zones: ZoneArrays,
    halo: Halo,
    touching_m: float,
    border_m: float,
    zoned: ZoneState,
    side: int,
    zone: int,
    w: int,
    due: NDArray[np.void],
) -> None:
    """Append the owned rows of one zone to the rows of all zones that need these rows.

    The target zones are searched first, in batches of the size of `due`. This search has
    unpredictable branches, which do not delay the copies if the search has its own loop.
    """
    near_limit = touching_m * touching_m
    border_limit = border_m * border_m
    if zoned.num_outer[zone, w] < 0:
        _note_all_outer(halo.inner[zone], zoned, side, zone, w)
    seen_limit = halo.seen_m * halo.seen_m
    sure_limit = halo.sure_m * halo.sure_m
    by_lane = halo.watcher_start.size > 1
    zoned.num_border[zone, w] = 0
    outers = zoned.outer[zone, w]
    num_outer = zoned.num_outer[zone, w]
    num_due = 0
    for n in range(num_outer):
        if by_lane and n + 2 * SOON < num_outer:
            prefetch(halo.watcher_start, outers[n + 2 * SOON]["lane"], 0)
            prefetch(halo.watchers, halo.watcher_start[outers[n + SOON]["lane"]], 0)
        if num_due + zones.rects.shape[0] > due.size:
            _send(zoned, side, zone, w, due, num_due)
            num_due = 0
        outer = outers[n]
        x = outer["x"]
        y = outer["y"]
        # Background vehicles are on their lanes; agents may be anywhere beside them.
        if by_lane and outer["driver"] == DRIVER_BACKGROUND:
            lane = outer["lane"]
            for k in range(halo.watcher_start[lane], halo.watcher_start[lane + 1]):
                watch = halo.watchers[k]
                other = watch["zone"]
                if other == zone:
                    continue
                squared = squared_distance(zones.rects, other, x, y)
                sought = (squared <= sure_limit) | may_be_considered(halo, watch, outer)
                _note_due(due[num_due], outer, other, squared, near_limit, border_limit)
                num_due += int((squared <= seen_limit) & sought)
        else:
            here = zone
            if squared_distance(zones.rects, zone, x, y) > 0.0:
                here = zone_of(zones, x, y)
            for k in range(halo.near_start[here], halo.near_start[here + 1]):
                other = halo.near[k]
                squared = squared_distance(zones.rects, other, x, y)
                if other != zone and is_seen(halo, other, outer, squared):
                    _note_due(due[num_due], outer, other, squared, near_limit, border_limit)
                    num_due += 1
    _send(zoned, side, zone, w, due, num_due)
    zoned.num_outer[zone, w] = -1


@inlined_kernel
def _note_due(
    due: np.void, outer: np.void, zone: int, squared: float, near_limit: float, border_limit: float
) -> None:
    """Write an entry for a row that a zone may need; the caller may later overwrite the entry."""
    due["row"] = outer["row"]
    due["zone"] = zone
    due["near"] = squared <= near_limit
    due["at_border"] = squared <= border_limit


@kernel
def _send(
    zoned: ZoneState, side: int, zone: int, w: int, due: NDArray[np.void], num_due: int
) -> None:
    """Copy rows of a zone to the zones that need them, and record rows at a border."""
    for n in range(num_due):
        if n + SOON < num_due:
            later = due[n + SOON]["row"]
            for line in range(ROW_LINES):
                prefetch(zoned.rows[side, zone, w], later, line)
            prefetch(zoned.step[zone, w], later, 0)
        i = due[n]["row"]
        _take_ghost(zoned, side, zone, i, due[n]["zone"], w, due[n]["near"])
        found = zoned.num_border[zone, w]
        # The entries of one row follow one another.
        if due[n]["at_border"] and (found == 0 or zoned.border[zone, w, found - 1] != i):
            zoned.border[zone, w, found] = i
            zoned.num_border[zone, w] = found + 1


@kernel
def _note_all_outer(
    inner: NDArray[np.float64], zoned: ZoneState, side: int, zone: int, w: int
) -> None:
    """List a zone's outer rows, as `advance` does, if rows have changed after `advance`."""
    outer = 0
    for i in range(zoned.num_owned[zone, w]):
        row = zoned.rows[side, zone, w, i]
        if not is_inside(inner, row["x"], row["y"]):
            note_outer(zoned.outer[zone, w, outer], row, i)
            outer += 1
    zoned.num_outer[zone, w] = outer


@inlined_kernel
def _take_ghost(
    zoned: ZoneState, side: int, source: int, i: int, zone: int, w: int, near: bool
) -> None:
    """Append row i of a zone to another zone's ghosts.

    Ghosts that can touch a vehicle of the zone come before all other ghosts. The step of the row's
    route is also copied, because the table of routes is far away in memory.
    """
    rows = zoned.rows[side, zone, w]
    step = zoned.step[zone, w]
    step_at = zoned.step_at[zone, w]
    place = zoned.num_rows[zone, w]
    if near:
        first_far = zoned.num_near[zone, w]
        rows[place] = rows[first_far]
        step[place] = step[first_far]
        step_at[place] = step_at[first_far]
        place = first_far
        zoned.num_near[zone, w] += 1
    rows[place] = zoned.rows[side, source, w, i]
    step[place] = zoned.step[source, w, i]
    step_at[place] = zoned.step_at[source, w, i]
    zoned.num_rows[zone, w] += 1


@kernel
def take_own(
    zones: ZoneArrays, zone: int, source: NDArray[np.void], num: int, rows: NDArray[np.void]
) -> int:  # number of rows
    """Copy the rows of `source[:num]` in a zone to the front of `rows`, as rows that it owns.

    `source` and `rows` may be the same array.
    """
    found = 0
    for i in range(num):
        if zone_of(zones, source[i]["x"], source[i]["y"]) == zone:
            rows[found] = source[i]
            rows[found]["owner"] = zone
            found += 1
    return found
