"""Roads, vehicles and observations of highway-env as records of cavmarl.

The y axis of highway-env points down, so lanes, positions and headings are mirrored. Each lane of
highway-env becomes a polyline. Vehicles get ids in the order of the list in highway-env.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import Grid, fill_grid, make_grid
from cavmarl.core.records.arrays import LaneGrid, RoadArrays
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.roads.network import LANE
from tests.support.builders import points_of

SAMPLES = 64  # number of points of a curved lane
# Class attributes of drivers that the intersection environment of highway-env overwrites.
OVERWRITTEN = ("DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN")


def make(name: str, seed: int, **config: Any) -> Any:
    """Return an environment of highway-env one second after its reset."""
    pytest.importorskip("highway_env", reason="needs cavmarl[bench]")
    import gymnasium
    import highway_env
    from highway_env.vehicle.behavior import IDMVehicle

    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as restored:
        warnings.simplefilter("ignore")
        for word in OVERWRITTEN:
            restored.setattr(IDMVehicle, word, getattr(IDMVehicle, word))
        gymnasium.register_envs(highway_env)
        env = gymnasium.make(name, config=config).unwrapped
        env.reset(seed=seed)
        env.step(env.action_space.sample())
    return env


def lanes(env: Any) -> dict[tuple[Any, ...], Any]:
    """Return the lanes of highway-env in the order of the LANE rows."""
    found: dict[tuple[Any, ...], Any] = env.road.network.lanes_dict()
    return found


def roads(env: Any) -> RoadArrays:
    """Return the lanes of highway-env as road arrays, without links and signals."""
    parts, first = [], 0
    rows = np.zeros(len(lanes(env)), LANE)
    for row, lane in zip(rows, lanes(env).values(), strict=True):
        straight = type(lane).__name__ == "StraightLane"
        s = np.linspace(0.0, lane.length, 2 if straight else SAMPLES)
        corners = np.zeros((len(s), 3))
        corners[:, :2] = [lane.position(at, 0.0) * (1.0, -1.0) for at in s]
        parts.append(points_of(corners))
        row["first_point"], row["num_points"] = first, len(s)
        row["length_m"] = parts[-1]["s"][-1]
        row["width_m"] = lane.width_at(0.0)
        row["min_x"], row["min_y"] = corners[:, :2].min(axis=0)
        row["max_x"], row["max_y"] = corners[:, :2].max(axis=0)
        first += len(s)
    empty: Any = np.zeros(0, np.int32)
    others = len(RoadArrays._fields) - 2
    return RoadArrays(np.concatenate(parts), rows, *([empty] * others))


def everywhere(road: RoadArrays) -> LaneGrid:
    """Return a grid whose only cell contains all lanes."""
    num = len(road.lanes)
    start = np.array([0, num], np.int32)
    return LaneGrid(-1e4, -1e4, 2e4, 1, 1, start, np.arange(num, dtype=np.int32))


def vehicles(env: Any) -> NDArray[np.void]:
    """Return highway-env's vehicles as VEHICLE rows; goal k is the destination of vehicle k."""
    index = {key: row for row, key in enumerate(lanes(env))}
    rows = np.zeros(len(env.road.vehicles), VEHICLE)
    for k, (row, vehicle) in enumerate(zip(rows, env.road.vehicles, strict=True)):
        row["id"] = row["goal"] = k
        row["x"], row["y"] = vehicle.position * (1.0, -1.0)
        row["heading"], row["speed"] = -vehicle.heading, vehicle.speed
        row["length"], row["width"] = vehicle.LENGTH, vehicle.WIDTH
        row["lane"] = index[tuple(vehicle.lane_index)]
        along, right = vehicle.lane.local_coordinates(vehicle.position)
        row["s"], row["d"] = along, -right
        row["height"] = 1.6
    return rows


def destinations(env: Any) -> NDArray[np.float64]:
    """Return (1, vehicles, 2): x and y of each vehicle's destination in m."""
    return np.array([[vehicle.destination * (1.0, -1.0) for vehicle in env.road.vehicles]])


def grid_of(rows: NDArray[np.void]) -> Grid:
    """Return a spatial index of the vehicles."""
    grid = make_grid((-100.0, -100.0, 500.0, 100.0), 25.0, len(rows))
    fill_grid(rows, len(rows), grid)
    return grid


def observation(env: Any, kind: str, **config: Any) -> NDArray[np.float32]:
    """Return the observation of highway-env's first vehicle."""
    from highway_env.envs.common.observation import observation_factory

    with np.errstate(invalid="ignore"):
        seen: NDArray[np.float32] = observation_factory(env, {"type": kind, **config}).observe()
    return seen


def own_row(env: Any) -> int:
    """Return the row of the ego vehicle."""
    return int(env.road.vehicles.index(env.vehicle))
