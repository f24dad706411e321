"""`WorldsJob`: what a worker does that runs some of the worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config import EnvConfig
from cavmarl.errors import WorkerStartError
from cavmarl.runtime.shared_memory import Segment, arrays_in
from cavmarl.shard.shard import Commands
from cavmarl.stepping.arrays import StepArrays, layout_of
from cavmarl.stepping.local import LocalWorlds
from cavmarl.worlds import World, make_world

__all__ = ["Task", "WorldsJob", "fingerprint", "make_jobs"]


class Task(IntEnum):
    """What a worker can be asked for."""

    STEP = 0
    RESET = 1
    SUGGEST = 2
    STATE_HASH = 3
    TRAFFIC_STATS = 4


class WorldsJob:
    """Some of the worlds, next to each other.

    Args:
        worlds: that write their part of the shared arrays.
        first: number of the first one among all.
    """

    def __init__(self, worlds: LocalWorlds, first: int) -> None:
        self._worlds = worlds
        self._first = first
        self._commands = Commands(worlds.arrays.controls, worlds.arrays.meta_actions)

    def perform(self, task: int, letter: Any) -> Any:
        """Do a task; the answer of those that have one."""
        worlds = self._worlds
        if task == Task.STEP:
            worlds.step(self._commands)
        elif task == Task.RESET:
            everywhere = np.unpackbits(np.frombuffer(bytes.fromhex(letter["chosen"]), np.uint8))
            chosen = everywhere[self._first :][: len(worlds.arrays.mask)] == 1
            if chosen.any():
                worlds.reset(letter["seed"], letter["first_world"] + self._first, chosen)
        elif task == Task.SUGGEST:
            worlds.suggest()
        elif task == Task.STATE_HASH:
            return worlds.state_hash(letter - self._first)
        else:
            return worlds.traffic_stats(letter - self._first)
        return None

    def save(self) -> list[NDArray[Any]]:
        """All that the next step depends on."""
        return self._worlds.save()

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Go on from what `save` gave."""
        self._worlds.load(saved)


def fingerprint(world: World) -> str:
    """What tells two readings of the same files apart, if somebody has changed one between."""
    made_of = (world.network, world.demand, world.partition)
    return " ".join("none" if part is None else part.content_hash for part in made_of)


def make_jobs(recipe: Mapping[str, Any]) -> list[WorldsJob]:
    """The jobs of all workers, every kernel loaded.

    Args:
        recipe: what `pooled.PooledWorlds` writes.

    Raises:
        WorkerStartError: a file is not what it was.
    """
    from cavmarl.config_io import validate  # pydantic is slow to import

    config = validate(EnvConfig, recipe["config"], "the environment")
    world = make_world(config, Path(recipe["base_dir"]))
    if fingerprint(world) != recipe["fingerprint"]:
        raise WorkerStartError(
            f"the files of '{config.name}' have changed while workers were started: try again"
        )
    layout = layout_of(config, recipe["num_worlds"])
    arrays = StepArrays(**arrays_in(Segment(recipe["arrays"], 0).map(), layout))
    LocalWorlds(world, 1, warm=True)
    in_next_step = recipe["in_next_step"]

    def make(first: int, last: int) -> WorldsJob:
        part = arrays.part(first, last)
        return WorldsJob(LocalWorlds(world, last - first, part, in_next_step=in_next_step), first)

    return [make(first, last) for first, last in recipe["parts"]]
