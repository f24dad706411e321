"""Overhead of stepping worlds over worker processes, measured with worlds that do nothing.

Each worker has one world with an equal share of the agents. In every library, agents observe the
same numbers, all rewards are 0 and no agent leaves. So a step takes only the time of vectorization.
`ORDER` is the time of cavmarl's workers without checking actions and copying results: actions are
written to shared memory, the command is sent and results are committed.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv
from pettingzoo import ParallelEnv

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, paired_ratio, silent, take_turns
from cavmarl.cli.output import about
from cavmarl.core.errors import ConfigError, MissingExtraError, require
from cavmarl.engine.spaces import flat_observation_space
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from cavmarl.shards.shard import Commands

PROGRAM = "benchmarks.trivial_worker"
SETTINGS = {"population.mode": "respawn", "observation.kind": "flat", "action.kind": "continuous"}
STEPS = 300  # steps per turn
WARM_STEPS = 50
ORDER = "our workers alone"
LIBRARIES = {
    "cavmarl": "cavmarl",
    ORDER: ORDER,
    "gymnasium": "Gymnasium's AsyncVectorEnv",
    "supersuit": "SuperSuit's concat_vec_envs_v1",
}

Step = Callable[[], object]


def measure(
    agents: Annotated[int, about("Total number of agents.")] = 100,
    workers: Annotated[int, about("Worker processes per library, one world each.")] = 2,
    repeats: Annotated[int, about("Turns of each library.")] = 7,
    say: Say = silent,
) -> BenchmarkReport:
    """Step worlds that do nothing through each library's workers, in turn."""
    if workers < 1 or agents < 1 or agents % workers:
        raise ConfigError(f"{agents} agents over {workers} workers: must divide evenly")
    each = agents // workers
    world = load_world("merge", agents=each, background=0, overrides=SETTINGS)
    size = flat_observation_space(world.config).shape[0]
    steps: dict[str, Step] = {}
    missing: dict[str, str] = {}
    with ExitStack() as stack:
        # Start libraries that fork this process first, before it maps shared memory.
        for library, make in (("supersuit", _supersuit), ("gymnasium", _gymnasium)):
            say(f"starting the workers of {library}")
            try:
                steps[library] = stack.enter_context(make(each, size, workers))
            except MissingExtraError as error:
                missing[library] = str(error)
        say("starting cavmarl")
        worlds = PooledWorlds(world, Path(), workers, workers, program=PROGRAM)
        vec = CavVectorEnv(worlds)
        stack.callback(vec.close)
        vec.reset(seed=0)
        actions = np.zeros((workers, each, 2), dtype=np.float32)
        idle = Commands(np.zeros(actions.shape), np.zeros(actions.shape[:2], dtype=np.int64))
        steps["cavmarl"] = partial(vec.step, actions)
        steps[ORDER] = partial(worlds.step, idle)
        sides = {name: partial(_microseconds, step) for name, step in steps.items()}
        turns = take_turns(sides, repeats, say)
    rows: list[dict[str, Any]] = []
    for library, name in LIBRARIES.items():
        row: dict[str, Any] = {"library": library, "name": name, "step_us": turns.get(library, ())}
        if row["step_us"]:
            row["median_us"] = median(row["step_us"])
            row["ratio"] = paired_ratio(row["step_us"], turns["cavmarl"])
            row["order_ratio"] = paired_ratio(row["step_us"], turns[ORDER])
        rows.append(row)
    return BenchmarkReport(
        f"a step of {agents} agents over {workers} workers, {size} numbers each",
        {
            "library": "name",
            "µs per step": "median_us:,.0f",
            "times ours": "ratio:.1f",
            "times our workers alone": "order_ratio:.1f",
        },
        rows,
        notes=[f"{LIBRARIES[library]}: not measured: {text}" for library, text in missing.items()],
        facts={"agents": agents, "workers": workers, "numbers": size, "missing": missing},
    )


def _microseconds(step: Step) -> float:
    """Return the median of a turn."""
    found = []
    for n in range(WARM_STEPS + STEPS):
        began = time.perf_counter()
        step()
        if n >= WARM_STEPS:
            found.append(1e6 * (time.perf_counter() - began))
    return median(found)


@contextmanager
def _gymnasium(agents: int, size: int, workers: int) -> Iterator[Step]:
    vec = AsyncVectorEnv([partial(_TrivialWorld, agents, size)] * workers)
    try:
        vec.reset()
        yield partial(vec.step, np.zeros((workers, agents, 2), dtype=np.float32))
    finally:
        vec.close()


@contextmanager
def _supersuit(agents: int, size: int, workers: int) -> Iterator[Step]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of the library
        supersuit = require("supersuit", "bench")
        rows = supersuit.pettingzoo_env_to_vec_env_v1(_TrivialAgents(agents, size))
        vec = supersuit.concat_vec_envs_v1(rows, workers, workers, base_class="gymnasium")
        try:
            vec.reset()
            yield partial(vec.step, np.zeros((workers * agents, 2), dtype=np.float32))
        finally:
            vec.close()


def _boxes(*shape: int) -> tuple[spaces.Box, spaces.Box]:
    """Return the spaces of observations and actions."""
    *agents, size = shape
    actions = spaces.Box(-1.0, 1.0, (*agents, 2), np.float32)
    return spaces.Box(-1.0, 1.0, (*agents, size), np.float32), actions


class _TrivialWorld(gymnasium.Env[Any, Any]):
    """A world with all agents in one array."""

    def __init__(self, agents: int, size: int) -> None:
        self.observation_space, self.action_space = _boxes(agents, size)
        self._seen = np.zeros((agents, size), dtype=np.float32)

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        return self._seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._seen += 1.0
        return self._seen, 0.0, False, False, {}


class _TrivialAgents(ParallelEnv[str, Any, Any]):  # type: ignore[misc] # PettingZoo is not typed
    """A world with agents in dicts that are created once."""

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo declares it as an instance's attribute
        "name": "trivial",
        "is_parallelizable": True,
    }
    render_mode = None

    def __init__(self, agents: int, size: int) -> None:
        self.agents = self.possible_agents = [f"car_{k}" for k in range(agents)]
        observations, actions = _boxes(size)
        self.observation_spaces = dict.fromkeys(self.agents, observations)
        self.action_spaces = dict.fromkeys(self.agents, actions)
        self._batch = np.zeros((agents, size), dtype=np.float32)
        self._seen = dict(zip(self.agents, self._batch, strict=True))
        self._paid = dict.fromkeys(self.agents, 0.0)
        self._ended = dict.fromkeys(self.agents, False)
        self._told: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        return self._seen, self._told

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Any]:
        self._batch += 1.0
        return self._seen, self._paid, self._ended, self._ended, self._told


if __name__ == "__main__":
    run(measure)
