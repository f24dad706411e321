"""Run vector environments and compare their results."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl import CavVectorEnv
from cavmarl.parallel.processes.worker_pool import Pool
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds

__all__ = ["STEPS", "Make", "Run", "drive", "pool_of", "same"]

Make = Callable[..., CavVectorEnv]
Run = list[NDArray[Any] | str]
STEPS = 12


def pool_of(vec: CavVectorEnv) -> Pool:
    assert isinstance(vec.worlds, PooledWorlds)
    return vec.worlds.pool


def drive(
    vec: CavVectorEnv,
    steps: int = STEPS,
    seed: int = 5,
    before: Callable[[int], None] = lambda step: None,
) -> Run:
    """Return all results of an episode's first steps; random noise is added to the actions."""
    observations, infos = vec.reset(seed=seed, options={"first_world": 3})
    found: Run = [observations, *infos.values()]
    rng = np.random.default_rng(seed)
    for step in range(steps):
        actions = vec.suggest_actions()
        if actions.dtype == np.float32:
            noise = rng.normal(0.0, 0.5, actions.shape)
            actions = np.clip(actions + noise, -1.0, 1.0).astype(np.float32)
        before(step)
        *arrays, infos = vec.step(actions)
        found += [*arrays, *(infos[name] for name in sorted(infos)), vec.state()]
    found += [vec.state_hash(w) for w in range(vec.num_envs)]
    found += [repr(vec.traffic_stats(w)) for w in range(vec.num_envs)]
    return found


def same(first: Run, second: Run) -> bool:
    return len(first) == len(second) and all(
        a == b if isinstance(a, str) else np.array_equal(a, b)
        for a, b in zip(first, second, strict=True)
    )
