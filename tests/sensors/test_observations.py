"""Every sensor in an environment: spaces, flat and dict observations, and stacks."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

import cavmarl
from cavmarl.config.registry import load_config
from cavmarl.engine.spaces import (
    flat_observation,
    flat_observation_space,
    named_observation,
    observation_parts,
)
from cavmarl.policies.policy import Policy
from cavmarl.sensors.observed import SENSORS, frame_size

with warnings.catch_warnings():
    # PettingZoo's test module imports deprecated environments.
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test

BOUNDED = ("presence", "vx", "vy", "heading", "cos_h", "sin_h", "cos_d", "sin_d", "ang_off")
EVERYTHING = {
    "sensors.lanes.range_m": 80.0,
    "sensors.signal.timing": True,
    "sensors.lidar.rays": 8,
    "sensors.lidar.speeds": True,
    "sensors.kinematics.vehicles_count": 5,
    "sensors.kinematics.features": list(BOUNDED),
    "sensors.occupancy_grid.features": ["presence", "vx", "long_off", "heading", "on_road"],
    "sensors.lidar_observation.cells": 16,
    "sensors.way.distances_m": [5.0, 20.0, 60.0],
    "sensors.way.lines": 2,
    "sensors.conflicts.count": 5,
    "sensors.history.steps": 3,
    "sensors.stack": 3,
}
IMAGE = {**EVERYTHING, "sensors.occupancy_grid.as_image": True}
NOTHING = {
    "sensors.ego.enabled": False, "sensors.route.points": 0, "sensors.neighbors.count": 0,
    "sensors.signal.enabled": False, "sensors.lanes.range_m": 0, "sensors.lidar.rays": 0,
}  # fmt: skip
ONLY_HIGHWAY = {**NOTHING, "sensors.kinematics.vehicles_count": 5}


def make(env: str = "merge", mode: str = "respawn", **overrides: Any) -> Any:
    """Make a small world. Its type is Any, because observations may be arrays or dicts."""
    return cavmarl.parallel_env(
        env, agents=4, background=10, seed=3, max_cycles=60,
        overrides={"population.mode": mode, "population.budget": 8, **overrides},
    )  # fmt: skip


def wild(env: Any, rng: np.random.Generator) -> dict[str, Any]:
    """Return full throttle and random steering, with which most vehicles soon end their trips."""
    return {agent: np.array([1.0, rng.uniform(-1.0, 1.0)]) for agent in env.agents}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("ego.enabled", True),
        ("route.points", 2),
        ("neighbors.count", 2),
        ("signal.enabled", True),
        ("lanes.range_m", 50.0),
        ("lidar.rays", 8),
        ("kinematics.vehicles_count", 2),
        ("occupancy_grid.features", ["presence"]),
        ("lidar_observation.cells", 8),
        ("way.lines", 2),
        ("conflicts.count", 3),
        ("history.steps", 2),
    ],
)
def test_each_sensor_can_be_the_only_one(key: str, value: object) -> None:
    env = make(**{**NOTHING, f"sensors.{key}": value})
    assert list(observation_parts(env.config.sensors)) == [key.partition(".")[0]]
    observations, _ = env.reset()
    assert all(env.observation_space(agent).contains(observations[agent]) for agent in env.agents)


@pytest.mark.parametrize("kind", ["flat", "dict"])
@pytest.mark.parametrize("mode", ["closed", "respawn"])
def test_pettingzoo_accepts_all_sensors_together(kind: str, mode: str) -> None:
    parallel_api_test(make("grid4x4", mode, **{**EVERYTHING, "observation.kind": kind}), 60)


@pytest.mark.parametrize("kind", ["flat", "dict"])
def test_gymnasium_accepts_all_sensors_together(kind: str) -> None:
    overrides = {**EVERYTHING, "observation.kind": kind}
    check_env(
        gymnasium.make("cavmarl/merge-v6", overrides=overrides).unwrapped, skip_render_check=True
    )


@pytest.mark.parametrize("overrides", [EVERYTHING, IMAGE], ids=["numbers", "image"])
@pytest.mark.parametrize("raw", [False, True])
def test_observations_lie_in_their_spaces(overrides: dict[str, Any], raw: bool) -> None:
    if raw:
        overrides = {
            **overrides,
            "sensors.kinematics.normalize": False,
            "sensors.occupancy_grid.clip": False,
            "sensors.lidar_observation.normalize": False,
        }
    for kind in ("flat", "dict"):
        env = make(**{**overrides, "observation.kind": kind})
        observations, _ = env.reset()
        rng = np.random.default_rng(0)
        for _ in range(40):
            for agent, seen in observations.items():
                assert env.observation_space(agent).contains(seen), agent
            observations, *_ = env.step(wild(env, rng))
    vec = cavmarl.make_vec("merge", num_envs=2, seed=0, overrides=overrides)
    assert vec.observation_space.contains(vec.reset()[0])


@pytest.mark.parametrize("overrides", [{}, EVERYTHING, IMAGE], ids=["default", "all", "image"])
def test_flat_and_dict_observations_contain_the_same_numbers(overrides: dict[str, Any]) -> None:
    flat, named = (make(**{**overrides, "observation.kind": kind}) for kind in ("flat", "dict"))
    config = named.config.sensors
    parts = observation_parts(config)
    vectors, _ = flat.reset()
    dicts, _ = named.reset()
    for agent, vector in vectors.items():
        np.testing.assert_array_equal(flat_observation(parts, dicts[agent], config.stack), vector)
        again = named_observation(parts, vector.reshape(config.stack, -1))
        assert list(again) == list(dicts[agent])
        for name, part in again.items():
            np.testing.assert_array_equal(part, dicts[agent][name])
            assert part.dtype == dicts[agent][name].dtype


def test_an_image_has_bytes() -> None:
    env = make(**{**IMAGE, "observation.kind": "dict"})
    image = env.reset()[0]["car_0"]["occupancy_grid"]
    assert image.dtype == np.uint8
    assert image.shape == (3, 5, 11, 11)
    assert image.max() == 255


@pytest.mark.parametrize("mode", ["respawn", "open"])
def test_a_stack_contains_the_last_frames_and_begins_with_copies_of_the_first(mode: str) -> None:
    plain, stacked = (make(mode=mode, **{**EVERYTHING, "sensors.stack": k}) for k in (1, 4))
    seen, _ = plain.reset()
    held, infos = stacked.reset()
    past: dict[str, list[NDArray[np.float32]]] = {}
    vehicle: dict[str, float] = {}
    fresh = 0
    rng = np.random.default_rng(2)
    for _ in range(60):
        for agent, frame in seen.items():
            if infos[agent]["vehicle_id"] < 0:
                assert not held[agent].any(), (
                    "an agent without a vehicle observes values other than 0"
                )
                continue
            if vehicle.get(agent) != infos[agent]["vehicle_id"]:
                vehicle[agent] = infos[agent]["vehicle_id"]
                past[agent] = [frame] * 3
                fresh += 1
            past[agent] = [*past[agent][-3:], frame]
            np.testing.assert_array_equal(held[agent], np.concatenate(past[agent]))
        if not stacked.agents:
            break
        actions = {agent: act for agent, act in wild(stacked, rng).items()
                   if infos[agent]["active"]}  # fmt: skip
        seen, *_ = plain.step(actions)
        held, _, _, _, infos = stacked.step(actions)
    assert fresh > 5, "no agent entered later"
    again, _ = stacked.reset()
    first = again[stacked.agents[0]].reshape(4, -1)
    assert np.all(first == first[0]), "a stack contains frames of the last episode"


def test_stacks_of_a_batch_equal_stacks_of_a_single_world() -> None:
    overrides = {**EVERYTHING, "population.mode": "respawn"}
    batch = cavmarl.make_vec("merge", num_envs=2, agents=4, background=10, overrides=overrides)
    alone = make(**EVERYTHING)
    observations, _ = batch.reset(seed=11)
    held, _ = alone.reset(seed=11)
    actions = np.zeros((2, 4, 2), np.float32)
    for _ in range(20):
        np.testing.assert_array_equal(observations[0], np.stack(list(held.values())))
        observations, *_ = batch.step(actions)
        held, *_ = alone.step({agent: np.zeros(2, np.float32) for agent in alone.agents})


class Recorder(Policy):
    """A policy that stores its flat observations."""

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        self.shown = observations
        return np.zeros((*mask.shape, 2), np.float32)


def test_policies_get_stacked_dicts_as_flat_vectors() -> None:
    flat, named = (make(**{**EVERYTHING, "observation.kind": kind}) for kind in ("flat", "dict"))
    policy = Recorder(named)
    policy.act(named.reset()[0])
    np.testing.assert_array_equal(policy.shown[0], np.stack(list(flat.reset()[0].values())))


def test_the_default_observation_of_highway_env_can_be_the_only_sensor() -> None:
    for kind, shape in (("flat", (25,)), ("dict", (5, 5))):
        env = make(**{**ONLY_HIGHWAY, "observation.kind": kind})
        seen = env.reset()[0]["car_0"]
        table = seen if kind == "flat" else seen["kinematics"]
        assert table.shape == shape
        assert table.reshape(5, 5)[0, 0] == 1.0
    assert frame_size(env.config.sensors) == 25


def test_features_of_a_sensor_have_different_names_and_the_bounds_of_the_space() -> None:
    told = {"v2x.enabled": True, "sensors.messages.objects": 4, "sensors.messages.events": 2}
    config, _ = load_config("merge", overrides=EVERYTHING | told)
    box = flat_observation_space(config)
    start = 0
    for sensor in SENSORS:
        features = sensor.features(config.sensors)
        assert len({feature.name for feature in features}) == len(features)
        assert observation_parts(config.sensors)[sensor.name].place.start == start
        for k, feature in enumerate(features):
            assert box.low[start + k] == np.float32(feature.low)
            assert box.high[start + k] == np.float32(feature.high)
        start += len(features)
    assert box.shape == (3 * start,)
