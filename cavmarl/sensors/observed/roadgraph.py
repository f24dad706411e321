"""The nearest points of the road network, as Waymax's `roadgraph_points`.

The points are those of lanes, lines, edges and stop lines; the kernel searches them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.sensors import SensorsConfig
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.nearest_road_points import (
    NUM_RINGS,
    ROAD_POINT,
    ROADGRAPH_FEATURES,
    TYPE_EDGE,
    TYPE_JUNCTION,
    TYPE_LANE,
    TYPE_LINE,
    TYPE_STOP,
    RoadgraphSensor,
    RoadPoints,
)
from cavmarl.sensors.observed.feature import Feature, Sensor

CELL_M = 16.0


def road_points(network: RoadNetwork, spacing_m: float) -> RoadPoints:
    """Points along all lines of a map, at most `spacing_m` apart, sorted into square cells.

    The index of a point is its place in `points`: by cell, then by lane, line and way along it.

    `spacing_m`: largest distance between one point of a line and the next.
    """
    parts = [
        line for lane in range(len(network.lanes)) for line in lines_along(network, lane, spacing_m)
    ]
    points = np.concatenate([*parts, _stop_lines(network)])
    min_x, min_y = float(points["x"].min()), float(points["y"].min())
    columns = ((points["x"] - min_x) // CELL_M).astype(np.int64)
    rows = ((points["y"] - min_y) // CELL_M).astype(np.int64)
    num_x, num_y = int(columns.max()) + 1, int(rows.max()) + 1
    cells = rows * num_x + columns
    points = points[np.argsort(cells, kind="stable")]
    start = np.zeros(num_x * num_y + 1, dtype=np.int32)
    start[1:] = np.cumsum(np.bincount(cells, minlength=num_x * num_y))
    points.setflags(write=False)
    start.setflags(write=False)
    return RoadPoints(min_x, min_y, CELL_M, num_x, num_y, start, points)


def lines_along(network: RoadNetwork, lane: int, spacing_m: float) -> list[NDArray[np.void]]:
    """The middle of a lane and, outside junctions, the lines that bound it, each as its points.

    The line between two lanes belongs to the right one.

    `lane`: row of `network.lanes`. `spacing_m`: largest distance between one point and the next.
    """
    row = network.lanes[lane]
    middle = _middle(network, lane, spacing_m)
    if row["internal"]:
        middle["type"] = TYPE_JUNCTION
        return [middle]
    middle["type"] = TYPE_LANE
    half = 0.5 * float(row["width_m"])
    lines = [middle, _beside(middle, half, TYPE_LINE if row["left"] >= 0 else TYPE_EDGE)]
    if row["right"] < 0:
        lines.append(_beside(middle, -half, TYPE_EDGE))
    return lines


def _middle(network: RoadNetwork, lane: int, spacing_m: float) -> NDArray[np.void]:
    """Points of a lane's middle, both ends included; their type is not set."""
    row = network.lanes[lane]
    line = network.points[row["first_point"] : row["first_point"] + row["num_points"]]
    count = max(math.ceil(float(row["length_m"]) / spacing_m), 1) + 1
    s = np.linspace(0.0, float(row["length_m"]), count)
    segment = np.clip(np.searchsorted(line["s"], s, side="right") - 1, 0, len(line) - 2)
    along = s - line["s"][segment]
    points = np.zeros(count, dtype=ROAD_POINT)
    for axis, slope in (("x", "cos"), ("y", "sin"), ("z", "slope")):
        points[axis] = line[axis][segment] + along * line[slope][segment]
    points["cos"], points["sin"] = line["cos"][segment], line["sin"][segment]
    return points


def _beside(middle: NDArray[np.void], left_m: float, kind: int) -> NDArray[np.void]:
    points = middle.copy()
    points["x"] -= left_m * middle["sin"]
    points["y"] += left_m * middle["cos"]
    points["type"] = kind
    return points


def _stop_lines(network: RoadNetwork) -> NDArray[np.void]:
    """One point at the end of each lane with a link that has a signal or a duty to give way."""
    yields = np.concatenate([[0], np.cumsum(network.conflicts["must_yield"])])
    first = network.links["first_conflict"]
    gives_way = yields[first + network.links["num_conflicts"]] > yields[first]
    stops = gives_way | (network.links["signal"] >= 0)
    lanes = np.unique(network.links["from_lane"][stops])
    points = np.zeros(len(lanes), dtype=ROAD_POINT)
    for k, lane in enumerate(lanes):
        points[k] = _middle(network, int(lane), math.inf)[-1]
    points["type"] = TYPE_STOP
    return points


def features(config: SensorsConfig) -> list[Feature]:
    """Ten numbers a point, nearest first; all 0 where there are fewer."""
    scale = f"{config.roadgraph.range_m:g} m"
    return [
        Feature(f"{name}_{k}", f"point {k}: {meaning}", unit, low)
        for k in range(config.roadgraph.points)
        for name, meaning, unit, low in (
            ("valid", "1 if there is one", "", 0.0),
            ("x", "forward place, ego frame", scale, -1.0),
            ("y", "place to the left, ego frame", scale, -1.0),
            ("dir_x", "its line's direction, forward part, ego frame", "", -1.0),
            ("dir_y", "its line's direction, part to the left, ego frame", "", -1.0),
            ("lane", "1 on the middle of a lane outside junctions", "", 0.0),
            ("junction", "1 on the middle of a lane inside a junction", "", 0.0),
            ("line", "1 between two lanes of a road", "", 0.0),
            ("edge", "1 where a road ends sideways", "", 0.0),
            ("stop", "1 on a stop line: a signal, or others have the right of way", "", 0.0),
        )
    ]


def shape(config: SensorsConfig) -> tuple[int, ...]:
    return config.roadgraph.points, ROADGRAPH_FEATURES


def settings(config: SensorsConfig, at: int, network: RoadNetwork) -> RoadgraphSensor:
    roadgraph = config.roadgraph
    road_map = road_points(network, roadgraph.spacing_m) if roadgraph.points else _no_points()
    size = len(road_map.points)
    return RoadgraphSensor(
        at=at,
        num_points=roadgraph.points,
        range_m=roadgraph.range_m,
        road_map=road_map,
        near_point=np.zeros(size, dtype=np.int64),
        near_squared=np.zeros(size),
        sorted_point=np.zeros(size, dtype=np.int64),
        sorted_squared=np.zeros(size),
        ring_start=np.zeros(NUM_RINGS + 1, dtype=np.int64),
    )


def _no_points() -> RoadPoints:
    points = np.zeros(0, dtype=ROAD_POINT)
    start = np.zeros(2, dtype=np.int32)
    for array in (points, start):
        array.setflags(write=False)
    return RoadPoints(0.0, 0.0, 1.0, 1, 1, start, points)


SENSOR = Sensor(
    "roadgraph",
    features,
    shape=shape,
    settings=lambda made: settings(made.config, made.at, made.network),
)
