"""The cells of `lidar_observation` equal those of highway-env, for bodies at any position."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.sensors import LidarObservationConfig, SensorsConfig
from cavmarl.sensors.kernels.highway_lidar import observe_lidar_cells
from cavmarl.sensors.observed import lidar_observation_sensor as lidar_observation
from tests.support import highway
from tests.support.builders import vehicles


def cells(rows: NDArray[np.void], i: int, **config: Any) -> NDArray[np.float32]:
    """Return the cells (cells, 2) that cavmarl computes for row i."""
    settings = SensorsConfig(lidar_observation=LidarObservationConfig(**config))
    sensor = lidar_observation.settings(settings, 0)
    out = np.zeros(np.prod(lidar_observation.shape(settings), dtype=int), np.float32)
    observe_lidar_cells(rows, i, highway.grid_of(rows), sensor, out)
    return out.reshape(lidar_observation.shape(settings))


@pytest.mark.parametrize("name", ["highway-v0", "merge-v0", "intersection-v1"])
@pytest.mark.parametrize("num_cells", [4, 16, 64])
@pytest.mark.parametrize("normalize", [True, False])
def test_the_cells_equal_those_of_highway_env(name: str, num_cells: int, normalize: bool) -> None:
    env = highway.make(name, 1)
    env.road.objects.clear()  # merge-v0 has an obstacle, and cavmarl has none
    config = {"cells": num_cells, "normalize": normalize}
    theirs = highway.observation(env, "LidarObservation", **config)
    ours = cells(highway.vehicles(env), highway.own_row(env), **config)
    np.testing.assert_allclose(ours, theirs, rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("seed", range(20))
def test_cells_are_equal_for_bodies_at_any_position(seed: int) -> None:
    env = highway.make("highway-v0", 0)
    env.road.objects.clear()
    rng = np.random.default_rng(seed)
    near = env.road.vehicles[:12]
    env.road.vehicles = near
    for vehicle in near:
        vehicle.position = rng.uniform(-40.0, 40.0, 2)
        vehicle.heading = rng.uniform(-np.pi, np.pi)
        vehicle.speed = rng.uniform(-5.0, 30.0)
    theirs = highway.observation(env, "LidarObservation", cells=32, maximum_range=45.0)
    rows = highway.vehicles(env)
    ours = cells(rows, highway.own_row(env), cells=32, maximum_range_m=45.0)
    np.testing.assert_allclose(ours, theirs, rtol=2e-6, atol=2e-6)
    assert np.any(theirs[:, 0] < 1.0)


def test_the_order_of_rows_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    places = [tuple(place) for place in rng.uniform(-25.0, 25.0, (10, 3))]
    rows = vehicles([*places, places[3]], speed=np.arange(11.0))
    order = rng.permutation(len(rows))
    for row in range(len(rows)):
        shuffled = cells(rows[order], int(np.flatnonzero(order == row)[0]), cells=16)
        np.testing.assert_array_equal(shuffled, cells(rows, row, cells=16))


def test_vehicles_on_other_levels_are_not_seen() -> None:
    rows = vehicles([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0)], z=[0.0, 6.0])
    assert np.all(cells(rows, 0, cells=8) == 1.0)
