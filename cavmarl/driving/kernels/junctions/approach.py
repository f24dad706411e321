"""Approaches: each vehicle registers at the link that it is on and at the links that it takes next.

The lists are contiguous in memory. They hold the values of a foe that decide the right of way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.compiled.prefetch import SOON, prefetch
from cavmarl.core.math.buckets import add, forget, lay_out
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import DRIVER_SCRIPTED
from cavmarl.core.records.rows import MERGES_M, SWEPT_BEYOND_M, is_lost
from cavmarl.driving.kernels.junctions.gaps import STATE_MAJOR
from cavmarl.driving.kernels.junctions.stop_line_registration import (
    can_be_ignored,
    registration_distance_m,
)
from cavmarl.driving.kernels.junctions.swept_areas import size_of
from cavmarl.driving.kernels.lanes.lane_index import beside_s
from cavmarl.driving.kernels.lanes.route_following import (
    fed_lane,
    next_step,
    next_step_from,
    own_step,
)

MAX_LINKS_AHEAD = 2
# With this distance from centre to lane end, a vehicle that waits for a lane change, or covers the
# lane next to its own, blocks the first link of the lane.
STANDS_BEFORE_M = 15.0
LEAST_M = 1e-9  # least registered distance beyond the line for a vehicle inside the junction
BLOCK = 64  # number of rows that stay in the cache between both loops

# A vehicle on a link, or before it.
APPROACH = np.dtype(
    [
        ("link", np.int32),
        ("row", np.int32),  # VEHICLE row
        ("dist", np.float64),  # from the centre to the stop line, m; negative beyond the line
        ("speed", np.float64),  # speed of the vehicle, m/s
        ("half", np.float64),  # half the length of the vehicle, m
        ("id", np.int64),
    ],
    align=True,
)


@kernel
def register_links(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,); rows[:num] live
    num: int,  # live rows
    step: NDArray[np.void],  # (C,) the PLAN of each row's lane; updated
    step_at: NDArray[np.int64],  # (C,) positions of `step` in the table, see `Worlds`; updated
    scratch: Scratch,  # the lists by link, approach and largest are written
) -> None:
    """List, for each link, the vehicles on it or approaching it in `scratch.approach`.

    Approaching vehicles are listed only for links with conflicts or swept areas.
    """
    pairs = 0
    scratch.largest[:] = 0
    for first in range(0, num, BLOCK):
        last = min(first + BLOCK, num)
        # Read the steps in a separate loop: in a city each step is a cache miss, and a loop that
        # does nothing else overlaps many of these misses. For most rows the step has not changed
        # since the previous tick.
        for i in range(first, last):
            if i + SOON < num:
                prefetch(roads.lanes, rows[i + SOON]["lane"], 0)
            if rows[i]["driver"] == DRIVER_SCRIPTED:
                continue
            at = own_step(roads, rows[i])
            if at + 1 != step_at[i] or at >= travel.num_fixed:
                step[i] = travel.steps[at]
                step_at[i] = at + 1
            prefetch(roads.lanes, step[i]["next"], 0)
            prefetch(roads.links, step[i]["link"], 0)
            prefetch(roads.links, step[i]["link"], 1)
        for i in range(first, last):
            if rows[i]["driver"] == DRIVER_SCRIPTED:
                pairs = _register_claims(roads, travel, rows[i], i, pairs, scratch)
                continue
            if is_lost(rows[i]):
                continue
            pairs = _register_row(roads, travel, rows[i], i, step[i], pairs, scratch)
    end = scratch.link_end
    forget(scratch.links)
    for k in range(pairs):
        add(scratch.links, scratch.pairs[k]["link"])
    lay_out(scratch.links)
    for k in range(pairs):
        link = scratch.pairs[k]["link"]
        scratch.approach[end[link]] = scratch.pairs[k]
        end[link] += 1


@inlined_kernel
def _append(
    roads: RoadArrays,
    scratch: Scratch,
    pairs: int,
    link: int,
    row: np.void,
    i: int,
    dist: float,
) -> int:
    pair = scratch.pairs[pairs]
    pair["link"] = link
    pair["row"] = i
    pair["dist"] = dist
    pair["speed"] = row["speed"]
    pair["half"] = 0.5 * row["length"]
    pair["id"] = row["id"]
    size = size_of(pair["half"])
    if size > 0:
        junction = roads.links[link]["junction"]
        scratch.largest[junction] = max(scratch.largest[junction], size)
    return pairs + 1


@kernel
def _register_claims(
    roads: RoadArrays, travel: TripTables, row: np.void, i: int, pairs: int, scratch: Scratch
) -> int:
    """Register a scripted row at the links of its script."""
    frame = travel.scripts.frames[row["goal"]]
    for c in range(frame["first_claim"], frame["first_claim"] + frame["num_claims"]):
        claim = travel.scripts.claims[c]
        pairs = _append(roads, scratch, pairs, claim["link"], row, i, claim["dist"])
    return pairs


@inlined_kernel
def _link_into(roads: RoadArrays, row: np.void) -> int:
    """Return the link by which a vehicle came to its lane, or -1.

    If the vehicle entered the road on this lane or has changed lanes, the result is the first link
    that leads to the lane or to an adjacent lane.
    """
    link = int(row["link"])
    if link >= 0 and roads.links[link]["to_lane"] == row["lane"]:
        return link
    here = roads.lanes[fed_lane(roads, row["lane"])]
    if here["num_into"] == 0:
        return -1
    before = roads.lanes[roads.into[here["first_into"]]]
    return int(before["link"]) if before["internal"] else -1


@inlined_kernel
def _register_row(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    i: int,
    step: np.void,
    pairs: int,
    scratch: Scratch,
) -> int:
    """Append the entries of row i, whose PLAN is `step`, and return the new number of entries."""
    lane = row["lane"]
    here = roads.lanes[lane]
    s = row["s"]
    if here["internal"]:
        driven_m = max(here["link_offset_m"] + s, LEAST_M)
        pairs = _append(roads, scratch, pairs, here["link"], row, i, -driven_m)
    elif s - 0.5 * row["length"] < SWEPT_BEYOND_M:
        # The centre has left the junction, but the rear is still in the junction, at the fork, or
        # in a swept area.
        link = _link_into(roads, row)
        if link >= 0:
            left = roads.links[link]
            minded = max(left["length_m"], left["fork_m"], left["swept_m"])
            if left["length_m"] + s - 0.5 * row["length"] < minded:
                pairs = _append(roads, scratch, pairs, link, row, i, -(left["length_m"] + s))
    side = row["side_lane"]
    if side >= 0 and not here["internal"] and roads.lanes[side]["num_links"] > 0:
        # The body also covers the adjacent lane, so it blocks that lane as well.
        to_end = roads.lanes[side]["length_m"] - beside_s(roads, lane, side, s)
        if to_end < STANDS_BEFORE_M:
            link = roads.lanes[side]["first_link"]
            pairs = _append(roads, scratch, pairs, link, row, i, max(to_end, 0.0))
    reach = registration_distance_m(row["speed"])
    distance = here["length_m"] - s
    way = row["way"]
    found = 0
    far = not can_be_ignored(row)  # vehicles that turn into this lane may have to yield to the row
    while distance < reach or (far and distance < MERGES_M and roads.lanes[lane]["merges"]):
        before, before_way = lane, way
        if lane == row["lane"] and way == row["way"]:
            lane, way, link = next_step_from(roads, step, lane, way)
        else:
            lane, way, link = next_step(roads, travel, lane, way)
        if lane < 0:
            # The vehicle has to change lanes before the end of the lane, where it blocks turning
            # vehicles, or its route ends there.
            last = roads.lanes[before]
            ends = travel.steps[before_way + before]["change"] == 0
            if (ends or distance < STANDS_BEFORE_M) and found == 0 and last["num_links"] > 0:
                pairs = _append(
                    roads, scratch, pairs, last["first_link"], row, i, max(distance, 0.0)
                )
            break
        if link >= 0:
            if roads.links[link]["num_conflicts"] + roads.links[link]["num_sweeps"] > 0:
                pairs = _append(roads, scratch, pairs, link, row, i, max(distance, 0.0))
            found += 1
            far &= roads.links[link]["state"] == STATE_MAJOR and not here["internal"]
            if found == MAX_LINKS_AHEAD:
                break
        distance += roads.lanes[lane]["length_m"]
    return pairs
