"""Find vehicles by lane and position, by a search over all vehicles."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.driving.kernels.junctions.stop_line_registration import registration_distance_m
from cavmarl.roads.network import RoadNetwork

Entry = tuple[float, int, int]  # s, id, row
VIEW_M = 250.0


def on_lane(roads: RoadNetwork, rows: NDArray[np.void], lane: int) -> list[Entry]:
    """Return the vehicles on a lane or partly on it, sorted by (s, id)."""
    found = []
    for i, row in enumerate(rows):
        if row["lane"] == lane:
            found.append((float(row["s"]), int(row["id"]), i))
        if row["side_lane"] == lane:
            found.append((beside_s(roads, int(row["lane"]), lane, row["s"]), int(row["id"]), i))
    return sorted(found)


def beside_s(roads: RoadNetwork, lane: int, neighbour: int, s: float) -> float:
    """Map a position to the adjacent lane, by interpolation between mapped points."""
    row = roads.lanes[lane]
    side = "left_s" if row["left"] == neighbour else "right_s"
    points = roads.points[row["first_point"] : row["first_point"] + row["num_points"]]
    for one, other in pairwise(points):
        if s < other["s"] or other is points[-1] or other["s"] == points[-1]["s"]:
            share = min(max((s - one["s"]) / (other["s"] - one["s"]), 0.0), 1.0)
            return float(one[side] + share * (other[side] - one[side]))
    raise AssertionError("a lane has segments")


def ahead(
    roads: RoadNetwork, rows: NDArray[np.void], i: int, lane: int, s: float
) -> tuple[int, float]:
    """Return (row, s) of the next vehicle ahead of (s, own id), or (-1, inf)."""
    for other_s, other_id, j in on_lane(roads, rows, lane):
        if j != i and (other_s, other_id) > (s, rows[i]["id"]):
            return (j, other_s) if other_s - s <= VIEW_M else (-1, math.inf)
    return -1, math.inf


def _behind_here(
    roads: RoadNetwork, rows: NDArray[np.void], i: int, lane: int, s: float
) -> tuple[int, float]:
    for other_s, other_id, j in reversed(on_lane(roads, rows, lane)):
        if j != i and (other_s, other_id) <= (s, rows[i]["id"]):
            return j, other_s
    return -1, -math.inf


def behind(
    roads: RoadNetwork, rows: NDArray[np.void], i: int, lane: int, s: float, reach_m: float
) -> tuple[int, float]:
    """Return (row, distance) of the nearest vehicle behind, also on earlier lanes, or (-1, inf)."""
    j, other_s = _behind_here(roads, rows, i, lane, s)
    if j >= 0:
        return (j, s - other_s) if s - other_s <= VIEW_M else (-1, math.inf)
    found = []
    for before in _into(roads, lane):
        distance = s
        for _ in range(4):
            if distance > reach_m:
                break
            length = float(roads.lanes[before]["length_m"])
            coming = [
                (distance + length - at, int(rows[j]["id"]), j)
                for at, _, j in on_lane(roads, rows, before)
                if j != i and distance + length - at < registration_distance_m(rows[j]["speed"])
            ]
            if coming and coming[-1][0] <= VIEW_M:
                found.append(coming[-1])
                break
            distance += length
            following = _into(roads, before)
            if not following:
                break
            before = following[0]
    if not found or min(found)[0] > VIEW_M:
        return -1, math.inf
    distance, _, j = min(found)
    return j, distance


def _into(roads: RoadNetwork, lane: int) -> list[int]:
    row = roads.lanes[lane]
    first = row["first_into"]
    return [int(before) for before in roads.into[first : first + row["num_into"]]]
