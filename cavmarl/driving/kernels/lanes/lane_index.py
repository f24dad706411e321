"""Lane index: the vehicles of one world sorted by lane and position, and searches in the index.

For each lane, the index lists the vehicles by increasing (s, id). A vehicle whose body also covers
an adjacent lane is in both lists. A scripted vehicle is in the lists of all lanes that it covers or
is about to cover. A vehicle far from all lanes (`is_lost`) is in no list. The values that other
drivers read are copied to the lists (records ENTRY), which are contiguous in memory. The index does
not depend on the order of rows.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.compiled.prefetch import SOON, prefetch
from cavmarl.core.math.buckets import add, forget, lay_out
from cavmarl.core.math.geometry import segment_at
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import DRIVER_SCRIPTED
from cavmarl.core.records.rows import is_lost
from cavmarl.driving.kernels.junctions.stop_line_registration import registration_distance_m

MAX_LOOK_BACK_LANES = 4
GOES_ON_M = 1.0  # lanes of one road end at the same place, within this tolerance
VIEW_M = 250.0  # upper limit of a world's viewing distance along the road

ENTRY = np.dtype(
    [
        ("s", np.float64),  # position of the centre on this lane, m
        ("speed", np.float64),  # speed of the vehicle, m/s
        ("half", np.float64),  # half the length of the vehicle, m
        ("decel", np.float64),  # comfortable deceleration, m/s², positive
        ("id", np.int64),
        ("row", np.int32),  # VEHICLE row
        ("blinker", np.int32),  # desired lane change: 1 left, -1 right
        ("side", np.bool_),  # the body covers this lane, but the centre is on an adjacent lane
    ],
    align=True,
)


@kernel
def beside_s(roads: RoadArrays, lane: int, neighbor: int, s: float) -> float:
    """Convert a position on a lane to the position beside it on a neighbour lane, in m.

    If the neighbour lane continues beside a junction (`goes_on_m`), add the distance driven inside
    the junction.
    """
    row = roads.lanes[lane]
    driven = 0.0
    if row["internal"] and not roads.lanes[neighbor]["internal"]:
        driven = row["link_offset_m"] + s
        lane = roads.links[row["link"]]["from_lane"]
        row = roads.lanes[lane]
        s = row["length_m"]
    k = segment_at(roads.points, row["first_point"], row["num_points"], s)
    point = roads.points[k]
    after = roads.points[k + 1]
    share = min(max((s - point["s"]) / (after["s"] - point["s"]), 0.0), 1.0)
    if neighbor == row["left"]:
        return float(driven + point["left_s"] + share * (after["left_s"] - point["left_s"]))
    return float(driven + point["right_s"] + share * (after["right_s"] - point["right_s"]))


@kernel
def goes_on_m(roads: RoadArrays, lane: int, neighbor: int) -> float:
    """Return how far, in m, a neighbour lane continues beside the junction at a lane's end."""
    row = roads.lanes[neighbor]
    end = roads.points[roads.lanes[lane]["first_point"] + roads.lanes[lane]["num_points"] - 1]
    place = end["left_s"] if neighbor == roads.lanes[lane]["left"] else end["right_s"]
    further = row["length_m"] - place
    return float(further) if further > GOES_ON_M else 0.0


@inlined_kernel
def _fill(
    entry: np.void, types: NDArray[np.void], row: np.void, i: int, s: float, side: bool
) -> None:
    entry["s"] = s
    entry["speed"] = row["speed"]
    entry["half"] = 0.5 * row["length"]
    entry["decel"] = types[row["vtype"]]["decel"]
    entry["id"] = row["id"]
    entry["row"] = i
    entry["blinker"] = row["blinker"]
    entry["side"] = side


@kernel
def index_lanes(
    roads: RoadArrays,
    travel: TripTables,  # the vehicles' types
    rows: NDArray[np.void],  # VEHICLE (C,); rows[:num] live
    num: int,  # live rows
    scratch: Scratch,  # the lists by lane and entries are written
) -> None:
    """Sort the vehicles of one world by (lane, s, id) into `scratch.entries`."""
    forget(scratch.lanes)
    for i in range(num):
        row = rows[i]
        prefetch(rows, i + 2 * SOON, 0)
        prefetch(rows, i + 2 * SOON, 1)
        if i + SOON < num:
            prefetch(scratch.lane_start, rows[i + SOON]["lane"], 0)
        if row["driver"] == DRIVER_SCRIPTED:
            _count_covers(travel, row, scratch)
            continue
        if is_lost(row):
            continue
        add(scratch.lanes, row["lane"])
        if row["side_lane"] >= 0:
            add(scratch.lanes, row["side_lane"])
    scratch.lane_start[roads.lanes.shape[0]] = lay_out(scratch.lanes)
    for i in range(num):
        row = rows[i]
        if row["driver"] == DRIVER_SCRIPTED:
            _insert_covers(travel, row, i, scratch)
            continue
        if is_lost(row):
            continue
        lane = row["lane"]
        _insert(scratch, travel.types, lane, row, i, row["s"], False)
        side = row["side_lane"]
        if side >= 0:
            s = beside_s(roads, lane, side, row["s"])
            _insert(scratch, travel.types, side, row, i, s, True)


@inlined_kernel
def _insert(
    scratch: Scratch, types: NDArray[np.void], lane: int, row: np.void, i: int, s: float, side: bool
) -> None:
    """Insert an entry into the list of its lane, by (s, id)."""
    k = _make_place(scratch, lane, s, row["id"])
    _fill(scratch.entries[k], types, row, i, s, side)


@inlined_kernel
def _make_place(scratch: Scratch, lane: int, s: float, own_id: int) -> int:
    """Make room for a new entry of a lane by (s, id), and return its index."""
    first = scratch.lane_start[lane]
    k = scratch.lane_end[lane]
    scratch.lane_end[lane] = k + 1
    entries = scratch.entries
    while k > first:
        before = entries[k - 1]
        if before["s"] < s or (before["s"] == s and before["id"] < own_id):
            break
        entries[k] = before
        k -= 1
    return int(k)


@kernel
def _count_covers(travel: TripTables, row: np.void, scratch: Scratch) -> None:
    """Count the entries of a scripted row."""
    frame = travel.scripts.frames[row["goal"]]
    for c in range(frame["first_cover"], frame["first_cover"] + frame["num_covers"]):
        add(scratch.lanes, travel.scripts.covers[c]["lane"])


@kernel
def _insert_covers(travel: TripTables, row: np.void, i: int, scratch: Scratch) -> None:
    """Insert a scripted row for all lanes that it covers or is about to cover."""
    frame = travel.scripts.frames[row["goal"]]
    for c in range(frame["first_cover"], frame["first_cover"] + frame["num_covers"]):
        cover = travel.scripts.covers[c]
        k = _make_place(scratch, cover["lane"], cover["s"], row["id"])
        entry = scratch.entries[k]
        _fill(entry, travel.types, row, i, cover["s"], True)
        entry["half"] = cover["half"]
        entry["speed"] = cover["speed"]


@kernel
def _first_after(scratch: Scratch, lane: int, s: float, own_id: int) -> int:
    """Return the index of the first entry on `lane` beyond (s, own_id)."""
    low = int(scratch.lane_start[lane])
    high = int(scratch.lane_end[lane])
    while low < high:
        middle = (low + high) // 2
        other = scratch.entries[middle]
        if other["s"] < s or (other["s"] == s and other["id"] <= own_id):
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def ahead_on(scratch: Scratch, lane: int, s: float, own_id: int, view_m: float) -> int:
    """Return the index of the next other vehicle on `lane` ahead of `s`, or -1.

    Vehicles beyond `view_m` are ignored. At equal s, the vehicle with the larger id counts as
    ahead, so that one of two vehicles is always the leader.
    """
    k = _first_after(scratch, lane, s, own_id)
    end = scratch.lane_end[lane]
    while k < end and scratch.entries[k]["id"] == own_id:
        k += 1
    return k if k < end and scratch.entries[k]["s"] - s <= view_m else -1


@kernel
def first_from(scratch: Scratch, lane: int, s: float, own_id: int) -> int:
    """Return the index of the rearmost other vehicle on `lane` at or beyond `s`, or -1."""
    k = _first_after(scratch, lane, s, -1)
    end = scratch.lane_end[lane]
    while k < end and scratch.entries[k]["id"] == own_id:
        k += 1
    return k if k < end else -1


@kernel
def num_ahead(scratch: Scratch, lane: int, s: float, own_id: int, view_m: float) -> int:
    """Return the number of vehicles on `lane` ahead of `s`, within `view_m`."""
    return _first_after(scratch, lane, s + view_m, own_id) - _first_after(scratch, lane, s, own_id)


@inlined_kernel
def last_on(scratch: Scratch, lane: int, own_id: int, distance: float, view_m: float) -> int:
    """Return the index of the rearmost other vehicle on `lane`, or -1.

    The ego vehicle is `distance` m before the start of the lane. Vehicles further from it than
    `view_m` are ignored.
    """
    k = int(scratch.lane_start[lane])
    end = scratch.lane_end[lane]
    while k < end and scratch.entries[k]["id"] == own_id:
        k += 1
    return k if k < end and distance + scratch.entries[k]["s"] <= view_m else -1


@kernel
def behind_on(scratch: Scratch, lane: int, s: float, own_id: int) -> int:
    """Return the index of the nearest other vehicle on `lane` behind `s`, or -1."""
    k = _first_after(scratch, lane, s, own_id) - 1
    first = scratch.lane_start[lane]
    while k >= first and scratch.entries[k]["id"] == own_id:
        k -= 1
    return k if k >= first else -1


@kernel
def _search_incoming(
    roads: RoadArrays,
    scratch: Scratch,
    before: int,
    s: float,
    own_id: int,
    reach_m: float,
    view_m: float,
) -> tuple[int, float]:
    """Find the nearest vehicle that comes from lane `before` to a place `s` m behind its end.

    The result has the form of `behind_by`. A vehicle that is too far to register at the line,
    because it is stopped or slow, is skipped.
    """
    distance = s
    for _ in range(MAX_LOOK_BACK_LANES):
        if distance > reach_m:
            break
        row = roads.lanes[before]
        for k in range(scratch.lane_end[before] - 1, scratch.lane_start[before] - 1, -1):
            other = scratch.entries[k]
            gap = distance + row["length_m"] - other["s"]
            if gap > view_m:
                break
            if gap < registration_distance_m(other["speed"]) and other["id"] != own_id:
                return k, gap
        distance += row["length_m"]
        if row["num_into"] == 0:
            break
        # Further back, only the first incoming lane is searched: the right of way decides about the
        # other lanes.
        before = roads.into[row["first_into"]]
    return -1, math.inf


@kernel
def behind_by(
    roads: RoadArrays,
    scratch: Scratch,
    lane: int,
    s: float,
    own_id: int,
    n: int,  # number of the incoming lane to search; 0 if there is none
    reach_m: float,
    view_m: float,
) -> tuple[int, float]:
    """Find the nearest vehicle behind `s` on `lane`.

    If the lane is free behind `s`, the search continues on the n-th incoming lane, across lane
    borders up to `reach_m` away, for a vehicle that registers at the line
    (`registration_distance_m`). A vehicle on the lane itself is returned only for n = 0, so that
    calls for all n return each follower once.

    Returns:
        The index of the entry and the distance in m, or (-1, inf) if there is none within `view_m`.
    """
    k = behind_on(scratch, lane, s, own_id)
    if k >= 0:
        apart = s - scratch.entries[k]["s"]
        return (k, apart) if n == 0 and apart <= view_m else (-1, math.inf)
    row = roads.lanes[lane]
    if n >= row["num_into"]:
        return -1, math.inf
    return _search_incoming(
        roads, scratch, roads.into[row["first_into"] + n], s, own_id, reach_m, view_m
    )
