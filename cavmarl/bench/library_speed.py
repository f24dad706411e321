"""What each library's view of the same world adds to a step of the world itself."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from statistics import median
from typing import Any

from cavmarl.bench.step_speed import one_core
from cavmarl.core.errors import ConfigError, MissingExtraError, require
from cavmarl.env.parallel import parallel_env
from cavmarl.env.vector import make_vec

__all__ = ["LibraryRow", "LibrarySpeed", "measure_library_speed"]

MAX_AGENTS = 10_000
WARM_STEPS = 3

Step = Callable[[], object]


@dataclass(frozen=True)
class LibraryRow:
    """One view of the world.

    Attributes:
        view: `arrays` (`make_vec`), `dicts` (`parallel_env`), `gymnasium`, `sb3`, `torchrl`, or
            `torchrl_stock`: TorchRL's own `PettingZooWrapper` around the dicts.
        step_ms: the processor's time of a step, the median; None: the library is missing.
        added_ms: median of what a step takes longer than one of `arrays` right before it.
        missing: how to install the library, where it is missing.
    """

    view: str
    step_ms: float | None
    added_ms: float | None
    missing: str = ""


@dataclass(frozen=True)
class LibrarySpeed:
    """All views, each measured step by step beside the arrays, on one core.

    Attributes:
        agents: of the one world.
        steps: of each view.
        rows: the views.
    """

    agents: int
    steps: int
    rows: tuple[LibraryRow, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def measure_library_speed(
    env: str = "town",
    agents: int = 1000,
    steps: int = 30,
    progress: Callable[[str], None] = lambda text: None,
) -> LibrarySpeed:
    """Step the same world through every library that is installed, kernels warm.

    Every view has a world of its own; all agents coast, and those that ended get new vehicles.

    Args:
        env: a name, a folder or a map file.
        agents: seats of the world; nobody else drives.
        steps: of each view.
        progress: told what is going on.

    Raises:
        ConfigError: a number out of range, or an environment that cannot work.
    """
    for name, value, most in (("agents", agents, MAX_AGENTS), ("steps", steps, 10_000)):
        if not 1 <= value <= most:
            raise ConfigError(f"{name} = {value}: must be from 1 to {most}")
    keys = {
        "population.mode": "seats",
        "observation.kind": "flat",
        "action.kind": "continuous",
    }
    settings = {"agents": agents, "background": 0, "overrides": keys}
    rows = []
    with one_core(), _one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what libraries say of themselves
        for view, make in VIEWS.items():
            progress(f"measuring {view}")
            try:
                step = make(env, settings)
            except MissingExtraError as error:
                rows.append(LibraryRow(view, None, None, str(error)))
            else:
                rows.append(_measure(view, step, _arrays(env, settings), steps))
    return LibrarySpeed(agents, steps, tuple(rows))


def _measure(view: str, step: Step, arrays: Step, steps: int) -> LibraryRow:
    for _ in range(WARM_STEPS):
        arrays()
        step()
    pairs = [(_milliseconds(arrays), _milliseconds(step)) for _ in range(steps)]
    added = median(mine - plain for plain, mine in pairs)
    return LibraryRow(view, median(mine for _, mine in pairs), added)


def _milliseconds(step: Step) -> float:
    """Of the processor: others on a busy machine do not count."""
    began = time.process_time_ns()
    step()
    return (time.process_time_ns() - began) / 1e6


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch, if it is there, to one thread: it is to have no more than the others."""
    try:
        torch = require("torch", "torch")
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
    from cavmarl.adapters.torchrl_env import GROUP, CavTorchRLEnv

    worlds = CavTorchRLEnv(env, **settings)
    worlds.set_seed(0)
    state = worlds.rand_action(worlds.reset())
    state[GROUP, "action"].zero_()
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
