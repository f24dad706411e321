"""The nearest points of the road network, as the `roadgraph_points` of Waymax.

Gulino et al.: "Waymax: an accelerated, data-driven simulator for large-scale autonomous driving
research", NeurIPS 2023: each object sees the `k` points of lanes, lines and edges that are nearest
to it, with place, direction and type. The points of a map never change: they are sorted into cells
once, by `observed.roadgraph`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records import record

# ROAD_POINT["type"], in the order of the features that say which one it is
TYPE_LANE = 0  # middle of a lane outside junctions
TYPE_JUNCTION = 1  # middle of a lane inside a junction
TYPE_LINE = 2  # between two lanes of a road
TYPE_EDGE = 3  # where a road ends sideways
TYPE_STOP = 4  # stop line of a link with a signal or a duty to give way
NUM_ROAD_TYPES = 5

# valid, x, y, dir_x, dir_y, then one flag a type
ROADGRAPH_FEATURES = 5 + NUM_ROAD_TYPES

ROAD_POINT = record(
    ("x", np.float64),  # m
    ("y", np.float64),
    ("z", np.float64),
    ("cos", np.float64),  # direction of the line that it is part of
    ("sin", np.float64),
    ("type", np.int64),  # TYPE_*
)

# Points are put into rings of equal area before they are sorted: few need to be compared.
NUM_RINGS = 256


class RoadPoints(NamedTuple):
    """Points of a road map in square cells."""

    min_x: float  # m, corner of cell (0, 0)
    min_y: float
    cell_m: float
    num_x: int
    num_y: int
    start: NDArray[np.int32]  # (num_x * num_y + 1,) points of cell c: [start[c], start[c + 1])
    points: NDArray[np.void]  # ROAD_POINT (N,)


class RoadgraphSensor(NamedTuple):
    """The nearest points of the road network."""

    at: int
    num_points: int  # 0: off
    range_m: float
    road_map: RoadPoints
    near_point: NDArray[np.int64]  # (N,) scratch
    near_squared: NDArray[np.float64]
    sorted_point: NDArray[np.int64]  # (N,) scratch; the answer
    sorted_squared: NDArray[np.float64]
    ring_start: NDArray[np.int64]  # (NUM_RINGS + 1,) scratch


@kernel
def _slot(offset: float, cell_m: float, count: int) -> int:
    """The cell along one axis; the first or the last one outside of the map."""
    return int(min(max(offset / cell_m, 0.0), count - 1.0))


@kernel
def _cells_around(
    road_map: RoadPoints, x: float, y: float, range_m: float
) -> tuple[int, int, int, int]:
    """First and last column, first and last row of the cells that a circle reaches."""
    size = road_map.cell_m
    return (
        _slot(x - range_m - road_map.min_x, size, road_map.num_x),
        _slot(x + range_m - road_map.min_x, size, road_map.num_x),
        _slot(y - range_m - road_map.min_y, size, road_map.num_y),
        _slot(y + range_m - road_map.min_y, size, road_map.num_y),
    )


@kernel
def _candidates(
    road_map: RoadPoints,
    x: float,
    y: float,
    z: float,
    range_m: float,
    near_point: NDArray[np.int64],
    near_squared: NDArray[np.float64],
) -> int:
    """All points in range and on the level, in the order of their index; returns how many."""
    left, right, low, high = _cells_around(road_map, x, y, range_m)
    found = 0
    for j in range(low, high + 1):
        begin = road_map.start[j * road_map.num_x + left]
        end = road_map.start[j * road_map.num_x + right + 1]
        for p in range(begin, end):
            point = road_map.points[p]
            dx = point["x"] - x
            dy = point["y"] - y
            squared = dx * dx + dy * dy
            if squared <= range_m * range_m and abs(point["z"] - z) <= LEVEL_HEIGHT_M:
                near_point[found] = p
                near_squared[found] = squared
                found += 1
    return found


@kernel
def _sort_into_rings(found: int, count: int, range_m: float, sensor: RoadgraphSensor) -> int:
    """Copy the candidates of the nearest rings into `sorted_*`, ring by ring; returns how many.

    So many rings that at least `count` candidates are in them, or all of them.
    """
    start = sensor.ring_start
    start[:] = 0
    per_square = (NUM_RINGS - 1.0) / (range_m * range_m)
    for c in range(found):
        start[int(sensor.near_squared[c] * per_square) + 1] += 1
    rings = 0
    while rings < NUM_RINGS:
        start[rings + 1] += start[rings]
        rings += 1
        if start[rings] >= count:
            break
    kept = start[rings]
    for c in range(found):
        squared = sensor.near_squared[c]
        ring = int(squared * per_square)
        if ring < rings:
            sensor.sorted_point[start[ring]] = sensor.near_point[c]
            sensor.sorted_squared[start[ring]] = squared
            start[ring] += 1
    return int(kept)


@kernel
def nearest_points(x: float, y: float, z: float, sensor: RoadgraphSensor) -> int:
    """The nearest road points around a place, by distance, then by index, into `sorted_point`.

    `z`: m; points more than `LEVEL_HEIGHT_M` above or below are not seen. `sensor`: settings,
    points and scratch.

    Returns how many were found, at most `sensor.num_points`.
    """
    points = sensor.sorted_point
    squares = sensor.sorted_squared
    found = _candidates(
        sensor.road_map, x, y, z, sensor.range_m, sensor.near_point, sensor.near_squared
    )
    kept = _sort_into_rings(found, sensor.num_points, sensor.range_m, sensor)
    for c in range(1, kept):
        point = points[c]
        squared = squares[c]
        place = c
        while place > 0 and squared < squares[place - 1]:
            points[place] = points[place - 1]
            squares[place] = squares[place - 1]
            place -= 1
        points[place] = point
        squares[place] = squared
    return min(kept, sensor.num_points)


@kernel
def observe_roadgraph(row: np.void, sensor: RoadgraphSensor, out: NDArray[np.float32]) -> None:
    """Write the nearest points in the ego frame, nearest first; what is left stays as it is.

    `sensor`: settings, points and scratch. `out`: an observation, zeros from `sensor.at` on.
    """
    cos, sin = cos_sin(row["heading"])
    found = nearest_points(row["x"], row["y"], row["z"], sensor)
    for k in range(found):
        point = sensor.road_map.points[sensor.sorted_point[k]]
        dx = point["x"] - row["x"]
        dy = point["y"] - row["y"]
        at = sensor.at + ROADGRAPH_FEATURES * k
        out[at] = 1.0
        out[at + 1] = (dx * cos + dy * sin) / sensor.range_m
        out[at + 2] = (dy * cos - dx * sin) / sensor.range_m
        out[at + 3] = clamp(point["cos"] * cos + point["sin"] * sin, -1.0, 1.0)
        out[at + 4] = clamp(point["sin"] * cos - point["cos"] * sin, -1.0, 1.0)
        out[at + 5 + point["type"]] = 1.0
