from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.config.sensors import RoadgraphConfig, SensorsConfig
from cavmarl.sensors.kernels.nearest_road_points import (
    ROADGRAPH_FEATURES,
    TYPE_EDGE,
    TYPE_JUNCTION,
    TYPE_LANE,
    TYPE_LINE,
    TYPE_STOP,
    RoadgraphSensor,
    nearest_points,
    observe_roadgraph,
)
from cavmarl.sensors.observed import roadgraph
from cavmarl.sensors.observed.roadgraph import road_points
from tests.naive import roadgraph as naive
from tests.support.builders import vehicles
from tests.support.traffic import NAMES, network


def config(points: int, range_m: float, spacing_m: float = 3.0) -> SensorsConfig:
    return SensorsConfig(roadgraph=RoadgraphConfig(points, range_m, spacing_m))


@cache
def settings_of(name: str, points: int, range_m: float = 50.0) -> RoadgraphSensor:
    """A sensor on a map, the same for all tests that change nothing of it."""
    return roadgraph.settings(config(points, range_m), 0, network(name))


@given(
    st.sampled_from(
        [(name, *size) for name in NAMES for size in ((5, 50.0), (64, 30.0), (200, 80.0))]
    ),
    st.floats(-0.1, 1.1),
    st.floats(-0.1, 1.1),
    st.sampled_from([0.0, 3.0, 9.0]),
)
def test_nearest_points_equal_twin(
    which: tuple[str, int, float], across: float, up: float, z: float
) -> None:
    sensor = settings_of(*which)
    min_x, min_y, max_x, max_y = network(which[0]).extent_m
    x, y = min_x + across * (max_x - min_x), min_y + up * (max_y - min_y)
    found = nearest_points(x, y, z, sensor)
    twin = naive.nearest_points(sensor.road_map, x, y, z, which[2], which[1])
    assert sensor.sorted_point[:found].tolist() == twin


def test_of_equally_near_points_the_smaller_index_comes_first() -> None:
    sensor = roadgraph.settings(config(7, 50.0), 0, network("grid4x4"))
    # Many points at the same place are equally near to everywhere.
    sensor.road_map.points.flags.writeable = True
    sensor.road_map.points["x"] = sensor.road_map.points["x"][0]
    sensor.road_map.points["y"] = sensor.road_map.points["y"][0]
    place = sensor.road_map.points[0]
    found = nearest_points(place["x"] + 1.0, place["y"], place["z"], sensor)
    assert sensor.sorted_point[:found].tolist() == naive.nearest_points(
        sensor.road_map, place["x"] + 1.0, place["y"], place["z"], 50.0, 7
    )


def frame(name: str, x: float, y: float, heading: float, points: int = 40) -> NDArray[np.float32]:
    """(points, ROADGRAPH_FEATURES) as seen from a place."""
    sensor = settings_of(name, points)
    out = np.zeros(points * ROADGRAPH_FEATURES, np.float32)
    observe_roadgraph(vehicles([(x, y, heading)])[0], sensor, out)
    return out.reshape(points, ROADGRAPH_FEATURES)


@given(st.floats(-3.0, 3.0))
def test_points_are_in_the_ego_frame(heading: float) -> None:
    sensor = settings_of("grid4x4", 40)
    x, y = (float(network("grid4x4").points[axis][3]) for axis in ("x", "y"))
    seen = frame("grid4x4", x, y, heading)
    assert np.all(seen[:, 0] == 1.0)
    assert np.all(seen[:, 5:].sum(axis=1) == 1.0), "a point is of one type"
    assert np.all(np.diff(np.hypot(seen[:, 1], seen[:, 2])) > -1e-6), "nearest first"
    nearest_points(x, y, 0.0, sensor)
    for k in range(40):
        point = sensor.road_map.points[sensor.sorted_point[k]]
        forward, left = naive.in_ego_frame((point["x"], point["y"]), (x, y), heading)
        assert seen[k, 1:3] * 50.0 == pytest.approx([forward, left], abs=1e-4)
        ahead, aside = naive.in_ego_frame((point["cos"], point["sin"]), (0.0, 0.0), heading)
        assert seen[k, 3:5] == pytest.approx([ahead, aside], abs=1e-5)
        assert seen[k, 5 + point["type"]] == 1.0


def test_far_from_all_roads_nothing_is_valid() -> None:
    assert not frame("ring", 5_000.0, 5_000.0, 0.0).any()


@pytest.mark.parametrize("name", NAMES)
def test_the_points_of_a_map(name: str) -> None:
    roads = network(name)
    points = road_points(roads, 2.0).points
    count = np.bincount(points["type"], minlength=5)
    outside = ~roads.lanes["internal"]
    length = roads.lanes["length_m"]
    # One point every 2 m at most, and one more a line.
    assert count[TYPE_LANE] >= length[outside].sum() / 2.0
    assert count[TYPE_LANE] <= length[outside].sum() / 2.0 + 2 * outside.sum()
    assert bool(count[TYPE_JUNCTION]) == bool(roads.lanes["internal"].any())
    assert bool(count[TYPE_LINE]) == bool((roads.lanes["left"] >= 0).any())
    assert count[TYPE_EDGE] > 0
    assert bool(count[TYPE_STOP]) == bool(
        (roads.links["signal"] >= 0).any() or roads.conflicts["must_yield"].any()
    )


def test_edges_lie_half_a_lane_beside_the_middle() -> None:
    roads = network("ring")
    points = road_points(roads, 2.0).points
    middle, edge = points[points["type"] == TYPE_LANE], points[points["type"] == TYPE_EDGE]
    beside = np.hypot(
        edge["x"][:, None] - middle["x"][None, :], edge["y"][:, None] - middle["y"][None, :]
    ).min(axis=1)
    assert beside == pytest.approx(0.5 * roads.lanes["width_m"].max(), abs=0.05)
