"""Vehicles beyond the declared reach change no observation and no reward term."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.driving.vehicle_types import generated_types
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.simulation import Simulation
from cavmarl.rewards.kernels.terms import TERMS_REACH_M
from cavmarl.sensors.observed import SENSORS, largest_radius_m, layout, sensing_reach_m
from tests.support.driving import drive, make_simulation, start
from tests.support.world import tick_of

TERMS_ALONE = "none but ego"
MOST = 30  # largest number of vehicles in a crowd
RADIUS_M = 0.5 * float(np.hypot(16.0, 3.0))  # half the diagonal of the largest vehicles
EVERYWHERE = np.ones(1, dtype=np.bool_)

OFF: dict[str, Any] = {
    "sensors.route.points": 0, "sensors.neighbors.count": 0, "sensors.signal.enabled": False,
    "sensors.lanes.range_m": 0.0, "sensors.lidar.rays": 0,
}  # fmt: skip
# Settings that switch one sensor on, with a larger reach than that of the reward terms.
ON: dict[str, dict[str, Any]] = {
    TERMS_ALONE: {},
    "route": {"sensors.route.points": 8},
    "neighbors": {"sensors.neighbors.count": 3, "sensors.neighbors.range_m": 70.0},
    "signal": {"sensors.signal.enabled": True, "sensors.signal.timing": True},
    "lanes": {"sensors.lanes.range_m": 80.0},
    "lidar": {
        "sensors.lidar.rays": 1024,
        "sensors.lidar.range_m": 65.0,
        "sensors.lidar.speeds": True,
    },
    "kinematics": {"sensors.kinematics.vehicles_count": 6, "sensors.kinematics.see_behind": True},
    "occupancy_grid": {
        "sensors.occupancy_grid.features": ["presence", "vx", "cos_d", "on_road"],
        "sensors.occupancy_grid.grid_size_m": [[-50.0, 60.0], [-50.0, 60.0]],
        "sensors.occupancy_grid.align_to_vehicle_axes": True,
    },
    "lidar_observation": {
        "sensors.lidar_observation.cells": 64,
        "sensors.lidar_observation.maximum_range_m": 75.0,
    },
    "way": {"sensors.way.distances_m": [5.0, 40.0], "sensors.way.lines": 2},
    "conflicts": {"sensors.conflicts.count": 6, "sensors.conflicts.range_m": 70.0},
    "history": {"sensors.history.steps": 2},
}
BLIND = {"route", "signal", "way", "history"}  # these sensors observe no vehicle
# This sensor observes an inbox. The message bus fills inboxes from any distance (see tests/v2x).
TOLD = {"messages"}


@cache
def world(env: str, sensor: str) -> Simulation:
    """Return a world after one step, whose agent has `ego` and one other sensor."""
    overrides = {**OFF, **ON[sensor]}
    simulation = make_simulation(env, mode="closed", agents=1, background=MOST, overrides=overrides)
    start(simulation, seed=4)
    drive(simulation)
    return simulation


@cache
def places(env: str) -> NDArray[np.float64]:
    """Return positions on all lanes as (N, 5): lane, s, x, y and heading."""
    network = world(env, TERMS_ALONE).network
    found = []
    for lane in range(len(network.lanes)):
        line = network.lane_polyline(lane)
        steps = np.diff(line[:, :2], axis=0)
        way = np.concatenate([[0.0], np.hypot(*steps.T).cumsum()])
        s = np.arange(0.0, way[-1], 0.2)
        segment = np.searchsorted(way, s, side="right") - 1
        heading = np.arctan2(steps[:, 1], steps[:, 0])[segment]
        x, y = (np.interp(s, way, line[:, axis]) for axis in (0, 1))
        found.append(np.stack([np.full_like(s, lane), s, x, y, heading], axis=1))
    return np.concatenate(found)


def agent_of(simulation: Simulation) -> NDArray[np.void]:
    rows = simulation.vehicles()
    return rows[rows["driver"] == DRIVER_AGENT].copy()


def far_from(rows: NDArray[np.void], agent: NDArray[np.void]) -> NDArray[np.float64]:
    distance: NDArray[np.float64] = np.hypot(rows["x"] - agent["x"], rows["y"] - agent["y"])
    return distance


def put(env: str, where: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.void]:
    """Return VEHICLE (n,) cars at rows of `places`, some with random headings."""
    rows = np.repeat(blank_vehicle(), where.size)
    rows["id"] = 1000 + rng.permutation(where.size)
    for name, column in zip(("lane", "s", "x", "y", "heading"), places(env)[where].T, strict=True):
        rows[name] = column
    rows["target_lane"] = rows["lane"]
    turned = rng.random(where.size) < 0.5
    rows["heading"] = np.where(turned, rng.uniform(-3.0, 3.0, where.size), rows["heading"])
    rows["speed"] = rng.uniform(0.0, 30.0, where.size)
    return rows


def sensed(simulation: Simulation, rows: NDArray[np.void]) -> tuple[bytes, bytes]:
    """Return the agent's observation and reward terms in a world of these vehicles."""
    worlds = simulation.worlds
    worlds.rows[0, : rows.size] = rows
    worlds.num_owned[0] = worlds.num_rows[0] = rows.size
    tick_of(simulation).sense(EVERYWHERE)
    outputs = simulation.outputs
    assert outputs.acted[0, 0]
    return outputs.observations[0, 0].tobytes(), outputs.terms[0, 0].tobytes()


def test_every_sensor_has_a_case_in_this_file() -> None:
    assert set(ON) - {TERMS_ALONE} == {sensor.name for sensor in SENSORS} - {"ego"} - TOLD
    for name in set(ON) - {TERMS_ALONE}:
        assert set(layout(world("grid4x4", name).config.sensors)) == {"ego", name}


@pytest.mark.parametrize("env", ["ring", "grid4x4"])
@pytest.mark.parametrize("sensor", ON)
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_crowd_beyond_the_reach_changes_nothing(env: str, sensor: str, seed: int) -> None:
    simulation = world(env, sensor)
    agent = agent_of(simulation)
    reach_m = sensing_reach_m(simulation.config.sensors, RADIUS_M)
    rng = np.random.default_rng(seed)
    near = np.hypot(*(places(env)[:, 2:4] - [agent["x"][0], agent["y"][0]]).T) < 1.5 * reach_m
    crowd = put(env, rng.choice(np.flatnonzero(near), int(rng.integers(1, MOST))), rng)
    crowd["length"] = rng.uniform(2.0, 16.0, crowd.size)
    crowd["width"] = rng.uniform(1.0, 3.0, crowd.size)
    everybody = sensed(simulation, np.concatenate([agent, crowd]))
    seen = crowd[far_from(crowd, agent) <= reach_m]
    assert sensed(simulation, np.concatenate([agent, seen])) == everybody


@pytest.mark.parametrize("sensor", sorted(set(ON) - BLIND))
def test_the_farthest_observed_vehicle_is_at_most_half_a_metre_within_the_reach(
    sensor: str,
) -> None:
    env = "grid4x4"
    simulation = world(env, sensor)
    agent = agent_of(simulation)
    radius_m = largest_radius_m(generated_types())
    looks = {one.name: one for one in SENSORS}
    config = simulation.config.sensors
    if sensor == TERMS_ALONE:
        reach_m, part = TERMS_REACH_M, 1
    else:
        reach_m, part = looks[sensor].reach_of_centres_m(config, radius_m), 0
    distance = np.hypot(*(places(env)[:, 2:4] - [agent["x"][0], agent["y"][0]]).T)
    rng = np.random.default_rng(0)
    others = put(env, np.flatnonzero(np.abs(distance - reach_m) < 1.0), rng)
    # Half of the vehicles drive straight towards the agent, which stands.
    agent["speed"] = 0.0
    towards = np.arctan2(agent["y"] - others["y"], agent["x"] - others["x"])
    others["heading"][::2] = towards[::2]
    alone = sensed(simulation, agent)[part]
    changes = [sensed(simulation, np.append(agent, other))[part] != alone for other in others]
    farthest = far_from(others, agent)[changes].max()
    assert reach_m - 0.5 < farthest <= reach_m


def test_the_reach_of_rays_is_their_range_plus_half_the_diagonal_of_a_body() -> None:
    simulation = world("grid4x4", "lidar")
    config = simulation.config.sensors
    assert sensing_reach_m(config, RADIUS_M) == config.lidar.range_m + RADIUS_M
    assert sensing_reach_m(world("grid4x4", "way").config.sensors, 9.0) == TERMS_REACH_M
