"""The occupancy grid equals that of highway-env on roads of highway-env."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.sensors import OccupancyGridConfig, SensorsConfig
from cavmarl.roads import routing
from cavmarl.sensors.kernels.occupancy import observe_occupancy
from cavmarl.sensors.observed import occupancy_grid_sensor
from tests.support import highway
from tests.support.traffic import network, on_lane

FEATURES = ("presence", "vx", "vy", "on_road")  # default of highway-env

CONFIGS: dict[str, dict[str, Any]] = {
    "default": {},
    "aligned": {"align_to_vehicle_axes": True},
    "fine": {"grid_size_m": ((-20.0, 60.0), (-10.0, 10.0)), "grid_step_m": (3.0, 2.0)},
    "image": {"as_image": True},
    "ranges": {
        "features": ("x", "cos_h", "heading", "vy", "sin_d"),
        "features_range": {"x": (-40.0, 40.0), "vy": (-5.0, 3.0)},
    },
    "unclipped": {"features": ("presence", "long_off", "y"), "clip": False},
}


def layers(env: Any, rows: NDArray[np.void], i: int, **config: Any) -> NDArray[np.float32]:
    """Return the grid (features, cells along x, cells along y) that cavmarl computes for row i."""
    settings = SensorsConfig(occupancy_grid=OccupancyGridConfig(**config))
    sensor = occupancy_grid_sensor.settings(settings, 0, network("ring"), highway.destinations(env))
    road = highway.roads(env)
    sensor = sensor._replace(lane_seen=np.zeros(len(road.lanes) + 1, np.int64))
    out = np.zeros(np.prod(occupancy_grid_sensor.shape(settings), dtype=int), np.float32)
    grid, lane_grid = highway.grid_of(rows), highway.everywhere(road)
    observe_occupancy(road, lane_grid, rows, i, grid, sensor, out)
    return out.reshape(occupancy_grid_sensor.shape(settings))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", ["highway-v0", "two-way-v0"])
@pytest.mark.parametrize("case", CONFIGS)
def test_the_grid_equals_that_of_highway_env(name: str, seed: int, case: str) -> None:
    env = highway.make(name, seed)
    rng = np.random.default_rng(seed)
    for vehicle in env.road.vehicles[:9]:
        if vehicle is not env.vehicle:
            vehicle.position = env.vehicle.position + rng.uniform((-20.0, -9.0), (25.0, 9.0))
            vehicle.heading = rng.uniform(-np.pi, np.pi)
    config = {"features": FEATURES, **CONFIGS[case]}
    renamed = {key.removesuffix("_m"): value for key, value in config.items()}
    theirs = highway.observation(env, "OccupancyGrid", **renamed)
    ours = layers(env, highway.vehicles(env), highway.own_row(env), **config)
    assert ours.shape == theirs.shape
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-7)
    assert np.count_nonzero(theirs[0]) > 2, "no vehicle was near"


def test_a_grid_turns_with_the_vehicle() -> None:
    env = highway.make("intersection-v1", 3)
    env.vehicle.heading = -1.0
    rows = highway.vehicles(env)
    for aligned in (False, True):
        theirs = highway.observation(
            env, "OccupancyGrid", features=["presence", "vx"], align_to_vehicle_axes=aligned
        )
        ours = layers(
            env, rows, highway.own_row(env), features=("presence", "vx"),
            align_to_vehicle_axes=aligned,
        )  # fmt: skip
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)


def test_a_cell_shows_the_vehicle_with_the_smallest_id_on_its_level() -> None:
    env = highway.make("highway-v0", 0)
    rows = highway.vehicles(env)[:3]
    for field in ("x", "y", "heading"):
        rows[field] = rows[field][0]
    rows["speed"], rows["id"], rows["z"] = [10.0, 20.0, 30.0], [7, 5, 1], [0.0, 0.0, 6.0]
    seen = layers(env, rows, 0, features=("vx",), features_range={"vx": (-10.0, 10.0)})
    assert seen[0, 5, 5] == pytest.approx(np.cos(rows["heading"][0]), abs=1e-6)
    assert np.count_nonzero(seen) == 1


@pytest.mark.parametrize("name", ["ring", "grid4x4", "merge"])
def test_the_grid_of_near_lanes_equals_the_grid_of_all_lanes(name: str) -> None:
    roads = network(name)
    settings = SensorsConfig(occupancy_grid=OccupancyGridConfig(features=("on_road",)))
    rng = np.random.default_rng(0)
    for lane in rng.integers(0, len(roads.lanes), 20):
        rows = on_lane(roads, int(lane), 0.3 * float(roads.lanes["length_m"][lane]))
        drawn = []
        for lane_grid in (routing.lane_grid(roads), highway.everywhere(roads.arrays)):
            sensor = occupancy_grid_sensor.settings(settings, 0, roads, np.zeros((1, 1, 2)))
            out = np.zeros(121, np.float32)
            observe_occupancy(roads.arrays, lane_grid, rows, 0, highway.grid_of(rows), sensor, out)
            drawn.append(out)
        np.testing.assert_array_equal(*drawn)
        assert drawn[0].reshape(11, 11)[4:7, 4:7].any(), (
            "the lane of the vehicle is not shown as road"
        )
