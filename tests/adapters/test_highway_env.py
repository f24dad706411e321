"""Tasks with the API of highway-env: loop, spaces, settings and meaning of actions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import cavmarl  # registers the ids in Gymnasium
from cavmarl.adapters.highway_tasks import TASKS
from cavmarl.config.library_names import HIGHWAY_TASKS
from cavmarl.core.errors import ConfigError

assert cavmarl


@pytest.fixture
def make() -> Iterator[Any]:
    made: list[gymnasium.Env[Any, Any]] = []

    def _make(task: str, **keywords: Any) -> gymnasium.Env[Any, Any]:
        made.append(gymnasium.make(f"cavmarl-highway/{task}-v0", **keywords))
        return made[-1]

    yield _make
    for env in made:
        env.close()


def test_each_task_has_an_id() -> None:
    assert set(HIGHWAY_TASKS) == set(TASKS)


@pytest.mark.parametrize("task", sorted(TASKS))
def test_the_loop_of_the_readme_of_highway_env_runs(task: str, make: Any) -> None:
    env = make(task, render_mode="rgb_array", config={"duration": 4})
    obs, info = env.reset(seed=1)
    terminated = truncated = False
    steps = 0
    while not (terminated or truncated):
        action = env.unwrapped.action_type.actions_indexes["IDLE"]
        obs, reward, terminated, truncated, info = env.step(action)
        steps += 1
        assert env.observation_space.contains(obs)
        assert np.isfinite(reward)
        assert info["crashed"] in (False, True)
        assert info["speed"] >= 0.0
    assert steps == 4 or terminated
    assert env.render().shape[2] == 3
    rows = TASKS[task].config.get("observation", {}).get("vehicles_count", 5)
    assert obs.shape[0] == rows


def test_a_task_passes_the_checker_of_gymnasium(make: Any) -> None:
    check_env(make("highway-fast").unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("observation", "shape"),
    [
        ({"type": "Kinematics", "vehicles_count": 7, "features": ["x", "vx"]}, (7, 2)),
        ({"type": "OccupancyGrid"}, (4, 11, 11)),
        ({"type": "OccupancyGrid", "grid_size": [[-10, 10], [-10, 10]]}, (4, 4, 4)),
        ({"type": "LidarObservation", "cells": 24}, (24, 2)),
    ],
)
def test_observations_have_the_shapes_of_highway_env(
    observation: dict[str, Any], shape: tuple[int, ...], make: Any
) -> None:
    env = make("merge", config={"observation": observation})
    assert env.observation_space.shape == shape
    assert env.reset(seed=0)[0].shape == shape


def test_steering_has_the_sign_of_highway_env(make: Any) -> None:
    config = {
        "action": {"type": "ContinuousAction"},
        "observation": {"type": "Kinematics", "features": ["y"], "normalize": False,
                        "absolute": True},
        "simulation_frequency": 10, "policy_frequency": 10,
    }  # fmt: skip
    env = make("highway", config=config)
    before = env.reset(seed=0)[0][0, 0]
    for _ in range(5):
        obs, *_ = env.step(np.array([0.0, 0.1], dtype=np.float32))
    assert (
        obs[0, 0] > before
    )  # y grows to the south, which is to the right of a car that drives east


@pytest.mark.parametrize(
    ("action", "space"),
    [
        ({"type": "DiscreteMetaAction", "lateral": False}, gymnasium.spaces.Discrete(3)),
        ({"type": "DiscreteMetaAction", "longitudinal": False}, gymnasium.spaces.Discrete(3)),
        ({"type": "DiscreteAction"}, gymnasium.spaces.Discrete(9)),
        (
            {"type": "ContinuousAction", "lateral": False},
            gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32),
        ),
    ],
)
def test_actions_have_the_spaces_of_highway_env(
    action: dict[str, Any], space: gymnasium.Space[Any], make: Any
) -> None:
    env = make("merge", config={"action": action})
    assert env.action_space == space
    env.reset(seed=0)
    env.step(env.action_space.sample())


def test_the_action_faster_has_a_higher_reward_than_slower(make: Any) -> None:
    rewards = {}
    for name in ("FASTER", "SLOWER"):
        env = make("highway")
        env.reset(seed=3)
        number = env.unwrapped.action_type.actions_indexes[name]
        for _ in range(4):
            _, rewards[name], ended, _, info = env.step(number)
            assert not ended
        assert 0.0 <= rewards[name] <= 1.0
        assert set(info["rewards"]) >= {"collision_reward", "high_speed_reward"}
    assert rewards["FASTER"] > rewards["SLOWER"]


@pytest.mark.parametrize(
    ("config", "told"),
    [
        ({"observation": {"type": "Grayscale"}}, "must be one of Kinematics"),
        ({"action": {"type": "Meta"}}, "must be one of DiscreteMetaAction"),
        ({"vehicle_count": 5}, "vehicle_count: unknown key"),
        ({"controlled_vehicles": 2}, "for several agents"),
        ({"lanes_count": 7}, "must be one of 3, 4"),
        ({"policy_frequency": 20}, "not be below policy_frequency"),
        ({"duration": -1}, "duration = -1: must be above 0"),
        ({"action": {"type": "ContinuousAction", "steering_range": [-1, 2]}}, "symmetric"),
    ],
)
def test_unsupported_features_are_refused(config: dict[str, Any], told: str, make: Any) -> None:
    with pytest.raises(ConfigError, match=told):
        make("highway", config=config)


def test_rendering_settings_of_highway_env_are_accepted_and_ignored(make: Any) -> None:
    env = make("highway", config={"screen_width": 640, "show_trajectories": True})
    assert "screen_width" not in env.unwrapped.config
