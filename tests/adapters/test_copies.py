"""A copy or pickle of an adapter has its own worlds, which continue bit for bit."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import cavmarl

COPIES: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}
SMALL: dict[str, Any] = {"background": 2, "max_cycles": 12}
ROWS = 4


def rows(**arguments: Any) -> Any:
    name = "cavmarl/mergeAgents-v6"
    made = gymnasium.make_vec(name, num_envs=ROWS, num_worlds=2, **SMALL, **arguments)
    made.reset(seed=1)
    return made


def sb3(**arguments: Any) -> Any:
    pytest.importorskip("stable_baselines3", reason="needs the extra: train")
    from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv

    made = CavSb3VecEnv("merge", num_worlds=2, agents=2, **SMALL, **arguments)
    made.seed(1)
    made.reset()
    return made


def torchrl(**arguments: Any) -> Any:
    pytest.importorskip("torchrl", reason="needs the extra: torchrl")
    from cavmarl.adapters.torchrl_env import CavTorchRLEnv

    made = CavTorchRLEnv("merge", num_envs=2, agents=2, **SMALL, **arguments)
    made.set_seed(1)
    made.reset()
    return made


def step_rows(env: Any) -> list[bytes]:
    """Step once; return the results without infos."""
    return [part.tobytes() for part in env.step(np.full((ROWS, 2), 0.3, np.float32))[:3]]


def step_tensors(env: Any) -> list[bytes]:
    """Step TorchRL's environment once; return observations, rewards and ends."""
    tensors = env.full_action_spec.zero()
    tensors["vehicles", "action"][:] = 0.3
    told = env.step(tensors)["next"]
    return [told["vehicles", name].numpy().tobytes() for name in ("observation", "reward", "done")]


VIEWS: dict[str, tuple[Callable[..., Any], Callable[[Any], list[bytes]]]] = {
    "rows": (rows, step_rows),
    "sb3": (sb3, step_rows),
    "torchrl": (torchrl, step_tensors),
}

# TorchRL warns about its own code when it is imported.
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning:torchrl"),
    pytest.mark.filterwarnings("ignore:Creating .* inherits from WeightUpdaterBase"),
]


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("view", VIEWS)
def test_a_copy_continues_like_the_original(view: str, how: str) -> None:
    make, step = VIEWS[view]
    env = make()
    for _ in range(3):
        step(env)
    other = COPIES[how](env)
    first = [step(env) for _ in range(15)]  # 15 steps end an episode
    assert [step(other) for _ in range(15)] == first
    assert len({parts[0] for parts in first}) > 10, "the worlds do not change"


@pytest.mark.parametrize("view", VIEWS)
def test_copies_of_worlds_in_worker_processes_are_refused(view: str) -> None:
    env = VIEWS[view][0](workers=1)
    with pytest.raises(cavmarl.ConfigError, match="backend='local'"):
        copy.deepcopy(env)
    env.close()


def test_copies_that_supersuit_makes_are_different_worlds() -> None:
    """PettingZoo recommends SuperSuit for training with stable-baselines3."""
    supersuit = pytest.importorskip("supersuit", reason="needs the extra: bench")
    stable_baselines3 = pytest.importorskip("stable_baselines3", reason="needs the extra: train")
    world = cavmarl.parallel_env("merge", agents=2, **SMALL)
    joined = supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(world), 2, num_cpus=0, base_class="stable_baselines3"
    )
    seen = joined.reset()
    assert seen.shape[0] == 4
    assert (np.abs(seen).sum(axis=1) > 0.0).all(), "a row is empty"
    assert len({row.tobytes() for row in seen}) == 4, "two rows are equal"
    model = stable_baselines3.PPO("MlpPolicy", joined, n_steps=8, batch_size=16, n_epochs=1)
    model.learn(2 * 8 * 4)
    joined.close()
