"""Run a world that a test changes between steps, and return its state hashes."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import closing
from typing import Any

from cavmarl import parallel_env


def hashes_of(
    act: Callable[[Any, int], None],  # called before each step with the environment and the step
    *,
    steps: int,
    every: int,
    kill_at: tuple[int, ...] = (),
    **world: Any,
) -> list[str]:
    """Return the state hash after every `every` steps; kill a worker before the steps `kill_at`.

    `world`: arguments of `parallel_env` on the map grid4x4.
    """
    with closing(parallel_env("grid4x4", **world)) as env:
        env.reset(seed=2)
        found = []
        for step in range(steps):
            act(env, step)
            actions = env.suggest_actions()
            if step in kill_at:
                os.kill(env.worlds.worker_pids[1], signal.SIGKILL)
            env.step(actions)
            if step % every == every - 1:
                found.append(env.state_hash())
        return found
