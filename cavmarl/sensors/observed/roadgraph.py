"""The nearest points of the road network, as Waymax's `roadgraph_points`."""

from __future__ import annotations

import numpy as np

from cavmarl.config.env import SensorsConfig
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.nearest_road_points import NUM_RINGS, ROAD_POINT, ROADGRAPH_FEATURES
from cavmarl.sensors.kernels.sensor_arrays import RoadgraphSensor, RoadPoints
from cavmarl.sensors.observed.feature import Feature
from cavmarl.sensors.observed.road_points import road_points


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
