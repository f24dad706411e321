"""The levels of lanes on bridges and in tunnels, and their crossings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.maps.heights.stations import STEP_M, Rows, Stations
from cavmarl.maps.net_document import Points
from cavmarl.maps.osm_roads import OsmRoads
from cavmarl.maps.projection import project
from cavmarl.roads.network import GeoReference

Levels = NDArray[np.int64]


def levels_of(stations: Stations, roads: OsmRoads, geo: GeoReference, source: Path) -> Levels:
    """Return the level of each place and junction: 0 on the ground, > 0 above, < 0 below."""
    levels = np.zeros(stations.graph.places, np.int64)
    raised = {name for name, way in roads.ways.items() if way.level}
    for row, lane in enumerate(stations.lanes):
        if lane.internal:
            continue
        ways = [name for name in dict.fromkeys(lane.ways) if name in roads.ways]
        for name in ways:
            if name not in raised:
                continue
            rows = stations.rows(row)
            level = roads.ways[name].level
            if len(ways) == 1:
                levels[rows] = level
                continue
            ends = _ends(roads, name, geo, source)
            if ends is not None:
                levels[rows][_between(stations.plane_m[rows], ends)] = level
    _spread_to_junctions(stations, levels)
    return levels


def _ends(roads: OsmRoads, name: str, geo: GeoReference, source: Path) -> Points | None:
    nodes = roads.ways[name].nodes
    ends = [roads.places[node] for node in (*nodes[:1], *nodes[-1:]) if node in roads.places]
    return project(source, np.array(ends), geo) if len(ends) == 2 else None


def _between(places: Points, ends: Points) -> NDArray[np.bool_]:
    """Return which places of a lane are between the places nearest to two points."""
    near = [int(hypot_all(*(places - end).T).argmin()) for end in ends]
    chosen = np.zeros(len(places), bool)
    chosen[min(near) : max(near) + 1] = True
    return chosen


def _spread_to_junctions(stations: Stations, levels: Levels) -> None:
    """Give a junction and its lanes the level of the lanes that meet there, if all share it."""
    base = int(stations.first[-1])
    ends: dict[int, set[int]] = {}
    around: dict[int, set[int]] = {}
    inner = {
        row for lane, one in enumerate(stations.lanes) if one.internal
        for row in range(stations.first[lane], stations.first[lane + 1])
    }  # fmt: skip
    for one, other in stations.graph.links.tolist():
        if other >= base:
            ends.setdefault(other, set()).add(int(levels[one]))
        elif (one in inner) != (other in inner):
            inside, outside = (one, other) if one in inner else (other, one)
            around.setdefault(inside, set()).add(int(levels[outside]))
    for hub, found in ends.items():
        if len(found) == 1:
            levels[hub] = found.pop()
    for lane, element in enumerate(stations.lanes):
        rows = stations.rows(lane)
        touched = [found for row in (rows.start, rows.stop - 1) for found in around.get(row, ())]
        if element.internal and touched and len(set(touched)) == 1:
            levels[rows] = touched[0]


def crossings(stations: Stations, levels: Levels) -> Rows:
    """Return pairs (n, 2) of places, the upper one first, where lanes of two levels cross."""
    start = np.delete(np.arange(stations.first[-1]), stations.first[1:] - 1)
    a, b = stations.plane_m[start], stations.plane_m[start + 1]
    level = levels[start]
    low, high = np.minimum(a, b), np.maximum(a, b)
    order = np.argsort(low[:, 0], kind="stable")  # no link is longer than STEP_M
    sorted_x = low[order, 0]
    found: set[tuple[int, int]] = set()
    for row in np.flatnonzero(level != 0).tolist():
        window = np.searchsorted(sorted_x, (low[row, 0] - STEP_M - 1e-6, high[row, 0]))
        others = order[window[0] : window[1] + 1]
        near = (low[others, 1] <= high[row, 1]) & (high[others, 1] >= low[row, 1])
        for other in others[near & (level[others] != level[row])].tolist():
            if _cross(a[row], b[row], a[other], b[other]):
                pair = (row, other) if level[row] > level[other] else (other, row)
                found.add((int(start[pair[0]]), int(start[pair[1]])))
    return np.array(sorted(found), dtype=np.int64).reshape(-1, 2)


def _cross(a: Points, b: Points, c: Points, d: Points) -> bool:
    def side(p: Points, q: Points, r: Points) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) < 0.0 and side(c, d, a) * side(c, d, b) < 0.0
