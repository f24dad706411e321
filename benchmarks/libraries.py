"""The time that each library's adapter adds to a step of the same world.

Each adapter has its own world. All agents coast, and agents whose trip ends get new vehicles. Times
are processor times on one core; each step is measured right after a step of the plain arrays.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from statistics import median
from typing import Annotated, Any

from benchmarks.program import run
from cavmarl.bench.harness import (
    BenchmarkReport,
    Say,
    check_positive,
    check_range,
    one_core,
    silent,
)
from cavmarl.cli.output import about
from cavmarl.core.errors import MissingExtraError, require
from cavmarl.env.parallel import parallel_env
from cavmarl.env.roadside_agents import VEHICLES
from cavmarl.env.vector import make_vec

WARM_STEPS = 3
KEYS = {"population.mode": "respawn", "observation.kind": "flat", "action.kind": "continuous"}

Step = Callable[[], object]


def measure(
    env: Annotated[str, about("Name, folder or map file of an environment.")] = "town",
    agents: Annotated[int, about("Agents in the one world.")] = 1000,
    steps: Annotated[int, about("Steps of each adapter.")] = 30,
    at_most: Annotated[
        float | None, about("Exit with 1 if TorchRL's adapter adds more ms per step.")
    ] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure the processor time that adapters add to a step of the same world."""
    check_positive("--at-most", at_most)
    check_range(agents=(agents, 1, 10_000), steps=(steps, 1, 10_000))
    settings = {"agents": agents, "background": 0, "overrides": KEYS}
    rows: list[dict[str, Any]] = []
    with one_core(), _one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of the libraries
        for view, make in VIEWS.items():
            say(f"measuring {view}")
            row: dict[str, Any] = {"view": view, "step_ms": None, "added_ms": None, "missing": ""}
            try:
                row |= _measured(make(env, settings), _arrays(env, settings), steps)
            except MissingExtraError as error:
                row["missing"] = str(error)
            rows.append(row)
    added = next(row["added_ms"] for row in rows if row["view"] == "torchrl")
    return BenchmarkReport(
        f"a step of one world with {agents:,} agents, in ms of one core: medians of {steps} steps",
        {"view": "view", "a step": "step_ms:.2f", "of it the view's": "added_ms:.2f"},
        rows,
        notes=[f"{row['view']}: {row['missing']}" for row in rows if row["missing"]],
        facts={"agents": agents, "steps": steps},
        holds=at_most is None or (added is not None and added <= at_most),
    )


def _measured(step: Step, arrays: Step, steps: int) -> dict[str, float]:
    for _ in range(WARM_STEPS):
        arrays()
        step()
    pairs = [(_milliseconds(arrays), _milliseconds(step)) for _ in range(steps)]
    return {
        "step_ms": median(taken for _, taken in pairs),
        "added_ms": median(taken - plain for plain, taken in pairs),
    }


def _milliseconds(step: Step) -> float:
    """Return the processor time of a step in ms; other programs do not affect it."""
    began = time.process_time_ns()
    step()
    return (time.process_time_ns() - began) / 1e6


@contextmanager
def _one_thread() -> Iterator[None]:
    """Restrict torch, if it is installed, to one thread."""
    try:
        torch = require("torch", "train")
    except MissingExtraError:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _arrays(env: str, settings: dict[str, Any]) -> Step:
    vec = make_vec(env, **settings)
    vec.reset(seed=0)
    return partial(vec.step, 0.0 * vec.action_space.sample())


def _dicts(env: str, settings: dict[str, Any]) -> Step:
    world = parallel_env(env, **settings)
    world.reset(seed=0)
    coast = 0.0 * world.action_space("car_0").sample()
    return partial(world.step, dict.fromkeys(world.possible_agents, coast))


def _gymnasium(env: str, settings: dict[str, Any]) -> Step:
    from cavmarl.adapters.gymnasium_rows import CavAgentRows

    seats = {key: value for key, value in settings.items() if key != "agents"}
    rows = CavAgentRows(env, num_envs=settings["agents"], **seats)
    rows.reset(seed=0)
    return partial(rows.step, 0.0 * rows.action_space.sample())


def _sb3(env: str, settings: dict[str, Any]) -> Step:
    from cavmarl.adapters.sb3_vec_env import CavSb3VecEnv

    rows = CavSb3VecEnv(env, **settings)
    rows.seed(0)
    rows.reset()
    return partial(rows.step, 0.0 * rows.action_space.sample()[None].repeat(rows.num_envs, axis=0))


def _torchrl(env: str, settings: dict[str, Any]) -> Step:
    from cavmarl.adapters.torchrl_env import CavTorchRLEnv

    worlds = CavTorchRLEnv(env, **settings)
    worlds.set_seed(0)
    state = worlds.rand_action(worlds.reset())
    state[VEHICLES, "action"].zero_()
    return partial(worlds.step, state)


def _torchrl_stock(env: str, settings: dict[str, Any]) -> Step:
    wrapper = require("torchrl.envs.libs.pettingzoo", "torchrl").PettingZooWrapper
    worlds = wrapper(parallel_env(env, **settings), use_mask=True, done_on_any=False, seed=0)
    state = worlds.rand_action(worlds.reset())
    for group in worlds.group_map:
        state[group, "action"].zero_()
    return partial(worlds.step, state)


VIEWS: dict[str, Callable[[str, dict[str, Any]], Step]] = {
    "arrays": _arrays,
    "dicts": _dicts,
    "gymnasium": _gymnasium,
    "sb3": _sb3,
    "torchrl": _torchrl,
    "torchrl_stock": _torchrl_stock,
}


if __name__ == "__main__":
    run(measure)
