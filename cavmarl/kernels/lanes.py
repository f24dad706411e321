"""Who is where on which lane: an index over the vehicles of one world, and searches along it.

The index lists, lane by lane, the vehicles on it by rising (s, id). A vehicle whose body also
covers a neighbour lane stands in both lists. Nothing here depends on the order of rows.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import RoadArrays, Scratch

__all__ = ["index_lanes", "last_on_lane", "neighbor_ahead", "neighbor_behind"]

MAX_LOOK_BACK_LANES = 4


@kernel
def index_lanes(
    lanes: NDArray[np.void], rows: NDArray[np.void], num: int, scratch: Scratch
) -> None:
    """Sort the vehicles of one world by (lane, s, id) into `scratch.entry_*`.

    Args:
        lanes: LANE (L,).
        rows: VEHICLE (C,), of which `num` live.
        num: live rows.
        scratch: lane_start, entry_row and entry_s are written.
    """
    start = scratch.lane_start
    num_lanes = lanes.shape[0]
    start[: num_lanes + 2] = 0
    for i in range(num):
        start[rows[i]["lane"] + 2] += 1
        if rows[i]["side_lane"] >= 0:
            start[rows[i]["side_lane"] + 2] += 1
    for lane in range(num_lanes):
        start[lane + 2] += start[lane + 1]
    # start[l + 1] is now where lane l's list begins; filling moves it to where the list ends.
    for i in range(num):
        lane = rows[i]["lane"]
        k = start[lane + 1]
        scratch.entry_row[k] = i
        scratch.entry_s[k] = rows[i]["s"]
        start[lane + 1] = k + 1
        side = rows[i]["side_lane"]
        if side >= 0:
            k = start[side + 1]
            scratch.entry_row[k] = i
            scratch.entry_s[k] = rows[i]["s"] * lanes[side]["length_m"] / lanes[lane]["length_m"]
            start[side + 1] = k + 1
    for lane in range(num_lanes):
        if start[lane + 1] - start[lane] > 1:
            _sort(rows, start[lane], start[lane + 1], scratch.entry_row, scratch.entry_s)


@kernel
def _sort(
    rows: NDArray[np.void],
    first: int,
    end: int,
    entry_row: NDArray[np.int32],
    entry_s: NDArray[np.float64],
) -> None:
    """Insertion sort of one lane's list by (s, id)."""
    for k in range(first + 1, end):
        i = entry_row[k]
        s = entry_s[k]
        own_id = rows[i]["id"]
        j = k
        while j > first:
            before = entry_s[j - 1]
            if before < s or (before == s and rows[entry_row[j - 1]]["id"] < own_id):
                break
            entry_row[j] = entry_row[j - 1]
            entry_s[j] = before
            j -= 1
        entry_row[j] = i
        entry_s[j] = s


@kernel
def _first_after(rows: NDArray[np.void], own_id: int, lane: int, s: float, scratch: Scratch) -> int:
    """Position in the index of the first entry on `lane` beyond (s, own_id)."""
    low = int(scratch.lane_start[lane])
    high = int(scratch.lane_start[lane + 1])
    while low < high:
        middle = (low + high) // 2
        other_s = scratch.entry_s[middle]
        if other_s < s or (other_s == s and rows[scratch.entry_row[middle]]["id"] <= own_id):
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def neighbor_ahead(
    rows: NDArray[np.void], i: int, lane: int, s: float, scratch: Scratch
) -> tuple[int, float]:
    """The next vehicle on `lane` ahead of place `s`: (row, its s) or (-1, inf).

    At equal s the larger id counts as ahead, so that of two vehicles one is always the leader.
    """
    k = _first_after(rows, rows[i]["id"], lane, s, scratch)
    end = scratch.lane_start[lane + 1]
    while k < end and scratch.entry_row[k] == i:
        k += 1
    if k == end:
        return -1, math.inf
    return scratch.entry_row[k], scratch.entry_s[k]


@kernel
def last_on_lane(i: int, lane: int, scratch: Scratch) -> tuple[int, float]:
    """The rearmost vehicle on `lane` other than row i: (row, its s) or (-1, inf)."""
    k = scratch.lane_start[lane]
    end = scratch.lane_start[lane + 1]
    while k < end and scratch.entry_row[k] == i:
        k += 1
    if k == end:
        return -1, math.inf
    return scratch.entry_row[k], scratch.entry_s[k]


@kernel
def _first_behind(
    rows: NDArray[np.void], i: int, lane: int, s: float, scratch: Scratch
) -> tuple[int, float]:
    """The nearest vehicle behind place `s` of the same lane: (row, its s) or (-1, -inf)."""
    k = _first_after(rows, rows[i]["id"], lane, s, scratch) - 1
    while k >= scratch.lane_start[lane] and scratch.entry_row[k] == i:
        k -= 1
    if k < scratch.lane_start[lane]:
        return -1, -math.inf
    return scratch.entry_row[k], scratch.entry_s[k]


@kernel
def neighbor_behind(
    roads: RoadArrays,
    rows: NDArray[np.void],
    i: int,
    lane: int,
    s: float,
    reach_m: float,
    scratch: Scratch,
) -> tuple[int, float]:
    """The nearest vehicle behind place `s` of `lane`: (row, distance in m) or (-1, inf).

    Looks back over lane borders, up to `reach_m` and along every lane that leads here; of several
    the nearest counts, at equal distances the smallest id.
    """
    best, best_s = _first_behind(rows, i, lane, s, scratch)
    if best >= 0:
        return best, s - best_s
    best_distance = math.inf
    row = roads.lanes[lane]
    for k in range(row["first_into"], row["first_into"] + row["num_into"]):
        before = roads.into[k]
        distance = s
        for _ in range(MAX_LOOK_BACK_LANES):
            if distance > reach_m:
                break
            length = roads.lanes[before]["length_m"]
            other, other_s = _first_behind(rows, i, before, math.inf, scratch)
            if other >= 0:
                gap = distance + length - other_s
                nearer = gap < best_distance
                tie = gap == best_distance and best >= 0 and rows[other]["id"] < rows[best]["id"]
                if nearer or tie:
                    best = other
                    best_distance = gap
                break
            distance += length
            if roads.lanes[before]["num_into"] == 0:
                break
            # Beyond a junction the first of the lanes that lead here stands for all: the others
            # are checked there, by the right of way.
            before = roads.into[roads.lanes[before]["first_into"]]
    return best, best_distance
