"""Worlds with worker processes run inside the daemonic workers of other libraries."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from cavmarl import make_vec


class WithWorkers(gymnasium.Env[Any, Any]):
    """A single-agent environment that steps worlds in its own worker process."""

    def __init__(self) -> None:
        self._vec = make_vec("ring", num_envs=1, workers=1, agents=1, background=2)
        self.observation_space = self._vec.single_observation_space
        self.action_space = self._vec.single_action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        observations, _ = self._vec.reset(seed=seed)
        return observations[0, 0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observations, rewards, ends, cuts, _ = self._vec.step(np.asarray(action)[None, None])
        return observations[0, 0], float(rewards[0, 0]), bool(ends[0, 0]), bool(cuts[0, 0]), {}

    def close(self) -> None:
        self._vec.close()


ACTIONS = np.zeros((2, 2), dtype=np.float32)


def test_worlds_with_workers_run_in_workers_of_gymnasium() -> None:
    vec = gymnasium.vector.AsyncVectorEnv([WithWorkers] * 2, context="spawn")
    observations, _ = vec.reset(seed=[1, 1])
    assert np.array_equal(observations[0], observations[1])
    moved, *_ = vec.step(ACTIONS)
    vec.close()
    assert not np.array_equal(moved, observations)


def test_worlds_with_workers_run_in_workers_of_stable_baselines3() -> None:
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import SubprocVecEnv

    vec = SubprocVecEnv([WithWorkers] * 2, start_method="spawn")
    vec.seed(1)
    observations = vec.reset()
    moved, *_ = vec.step(ACTIONS)
    vec.close()
    assert moved.shape == np.shape(observations)
