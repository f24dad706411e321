"""`CavEnv` over worker processes gives the results of one process, even if workers die."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cavmarl import CavEnv, ConfigError, parallel_env
from cavmarl.core.errors import EpisodeError
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from tests.support.pools import alive

SMALL = {"zones": 4, "agents": 4, "background": 12, "max_cycles": 20}


def settings(mode: str, kind: str = "flat") -> dict[str, Any]:
    keys = {"population.mode": mode, "population.budget": 7, "observation.kind": kind}
    return SMALL | {"overrides": keys}


def drive(env: CavEnv, before: Callable[[int], None] = lambda step: None) -> list[str]:
    """Return all results of two episodes as text with exact numbers."""
    found: list[str] = []
    rng = np.random.default_rng(3)
    with np.printoptions(threshold=10**9, floatmode="unique"):
        for seed in (5, None):
            found.append(repr(env.reset(seed=seed)))
            for step in range(10**4):
                if not env.agents:
                    break
                suggested = env.suggest_actions()
                noise = {agent: rng.normal(0.0, 0.5, 2) for agent in suggested}
                actions = {
                    agent: np.clip(action + noise[agent], -1.0, 1.0).astype(np.float32)
                    for agent, action in suggested.items()
                }
                before(step)
                found.append(repr(env.step(actions)))
                found += [repr(env.state()), env.state_hash(), repr(env.agents)]
            found.append(repr(env.traffic_stats()))
    return found


@pytest.mark.parametrize(
    ("mode", "kind", "workers"),
    [("closed", "flat", 1), ("closed", "dict", 2), ("open", "flat", 2), ("respawn", "flat", 2)],
)
def test_worlds_over_workers_equal_those_of_one_process(mode: str, kind: str, workers: int) -> None:
    whole = drive(parallel_env("grid4x4", **settings(mode, kind) | {"zones": 1}))
    env = parallel_env("grid4x4", workers=workers, **settings(mode, kind))
    assert drive(env) == whole
    env.close()


@pytest.mark.slow  # every run has similar tests: test_workers.py, test_split.py
def test_dead_workers_change_no_result() -> None:
    whole = drive(parallel_env("grid4x4", **settings("open")))
    env = parallel_env("grid4x4", workers=2, **settings("open"))
    assert isinstance(env.worlds, PooledWorlds)
    pool = env.worlds.pool

    def kill(step: int) -> None:
        if step % 5 == 2:
            os.kill(pool.pids[step % 2], signal.SIGKILL)

    assert drive(env, before=kill) == whole
    assert pool.deaths
    env.close()


def test_the_processes_end_with_the_environment() -> None:
    env = parallel_env("grid4x4", workers=2, **settings("closed"))
    env.reset(seed=0)
    assert isinstance(env.worlds, PooledWorlds)
    pids = env.worlds.pool.pids
    with pytest.raises(ConfigError, match="backend='local'"):
        _ = env.simulation
    env.close()
    assert alive(pids) == []
    with pytest.raises(EpisodeError, match="after close"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            {"backend": "ray:5", "zones": 4},
            r"nodes = 5: a world of 4 zone",
        ),
    ],
)
def test_bad_backends_are_refused(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        parallel_env("ring", **arguments)
