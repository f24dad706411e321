"""Worlds inside workers of other libraries have the same results as worlds of this process.

Python forbids such workers to start children with `multiprocessing`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from numpy.typing import NDArray

from cavmarl.engine.spaces import flat_observation_space
from cavmarl.env.vector import make_vec

WORKERS = (0, 1)  # worker processes of cavmarl within each worker of the library
STEPS = 30


class OneRow(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """An environment of the first agent of batched worlds, for workers of other libraries."""

    def __init__(self, workers: int) -> None:
        self.vec = make_vec(
            "merge", num_envs=2, agents=2, background=4, max_cycles=12, workers=workers
        )
        self.observation_space = flat_observation_space(self.vec.config)
        self.action_space = self.vec.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        return self.vec.reset(seed=seed)[0][0, 0], {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        actions = self.vec.suggest_actions()
        actions[0, 0] = action
        observations, rewards, ended, cut, _ = self.vec.step(actions)
        return observations[0, 0], float(rewards[0, 0]), bool(ended[0, 0]), bool(cut[0, 0]), {}

    def close(self) -> None:
        self.vec.close()


def drive(step: Callable[[NDArray[np.float32]], Any], count: int) -> list[Any]:
    """Step `count` rows STEPS times with random actions; return the results."""
    rng = np.random.default_rng(0)
    return [step(rng.uniform(-1.0, 1.0, (count, 2)).astype(np.float32)) for _ in range(STEPS)]


@pytest.mark.parametrize("autoreset", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
@pytest.mark.parametrize("workers", WORKERS)
def test_worlds_run_in_workers_of_gymnasiums_async_vector(
    workers: int, autoreset: AutoresetMode
) -> None:
    make = partial(OneRow, workers)
    here = gymnasium.vector.SyncVectorEnv([make, make], autoreset_mode=autoreset)
    there = AsyncVectorEnv([make, make], autoreset_mode=autoreset, context="forkserver")
    np.testing.assert_array_equal(there.reset(seed=3)[0], here.reset(seed=3)[0])
    pairs = zip(drive(there.step, 2), drive(here.step, 2), strict=True)
    for theirs, ours in pairs:
        for mine, other in zip(theirs[:4], ours[:4], strict=True):
            np.testing.assert_array_equal(mine, other)
    there.close()
    here.close()


@pytest.mark.parametrize("workers", WORKERS)
def test_worlds_run_in_workers_of_stable_baselines3(workers: int) -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra: train")
    envs = sb3.common.vec_env
    make = partial(OneRow, workers)
    here, there = envs.DummyVecEnv([make, make]), envs.SubprocVecEnv([make, make])
    for vec in (here, there):
        vec.seed(3)
    np.testing.assert_array_equal(there.reset(), here.reset())
    for theirs, ours in zip(drive(there.step, 2), drive(here.step, 2), strict=True):
        for mine, other in zip(theirs[:3], ours[:3], strict=True):
            np.testing.assert_array_equal(mine, other)
    there.close()
    here.close()


@pytest.mark.filterwarnings("ignore")  # Ray warns about its own code
@pytest.mark.parametrize("workers", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_worlds_run_in_a_ray_actor(workers: int) -> None:
    ray = pytest.importorskip("ray", reason="needs the extra: ray")
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        here, there = OneRow(workers), ray.remote(OneRow).remote(workers)
        first, _ = ray.get(there.reset.remote(seed=3))
        np.testing.assert_array_equal(first, here.reset(seed=3)[0])
        remote = drive(lambda actions: ray.get(there.step.remote(actions[0])), 1)
        for theirs, ours in zip(remote, drive(lambda a: here.step(a[0]), 1), strict=True):
            np.testing.assert_array_equal(theirs[0], ours[0])
            assert theirs[1:] == ours[1:]
        ray.get(there.close.remote())
        here.close()
    finally:
        ray.shutdown()
