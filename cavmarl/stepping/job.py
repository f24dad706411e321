"""What workers do: `WorldsJob` runs worlds, `FollowerJob` helps with one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config import EnvConfig
from cavmarl.errors import WorkerStartError
from cavmarl.runtime.shared_memory import Segment, arrays_in, shared_zeros
from cavmarl.runtime.team import Follower, Leader, Team
from cavmarl.runtime.worker import Job
from cavmarl.shard.shard import Commands, Shard
from cavmarl.stepping.arrays import StepArrays, layout_of
from cavmarl.stepping.local import LocalWorlds
from cavmarl.stepping.parts import Part
from cavmarl.worlds import World, make_world

__all__ = ["FollowerJob", "Task", "WorldsJob", "fingerprint", "make_jobs"]


class Task(IntEnum):
    """What a worker can be asked for."""

    STEP = 0
    RESET = 1
    SUGGEST = 2
    STATE_HASH = 3
    TRAFFIC_STATS = 4


ASKED = (Task.STATE_HASH, Task.TRAFFIC_STATS)  # of one worker, which answers alone


class WorldsJob:
    """Some of the worlds, next to each other.

    Args:
        worlds: that write their part of the shared arrays.
        first: number of the first one among all.
        hosted: the zones of each worker, if it is one world that several run; this one leads.
    """

    def __init__(
        self, worlds: LocalWorlds, first: int, hosted: Sequence[Sequence[int]] = ()
    ) -> None:
        self._worlds = worlds
        self._first = first
        self._hosted = hosted
        self._commands = Commands(worlds.arrays.controls, worlds.arrays.meta_actions)
        self._team: Team | None = None
        self._leader: Leader | None = None
        if hosted:
            worlds.simulation.host(self._lead)

    def _lead(self, shards: Sequence[Shard]) -> Leader:
        """Let a team run the phases of the one world."""
        commands, chosen = (self._commands,), (self._worlds.simulation.everywhere,)
        known = {
            "begin_step": commands,
            "move": commands,
            "sense": chosen,
            "credit": chosen,
            "suggest": (self._worlds.arrays.suggested,),
        }
        self._team = Team(shards, self._hosted, known)
        self._leader = Leader(self._team)
        return self._leader

    def followers(self) -> Iterator[FollowerJob]:
        """The jobs of the other workers."""
        for number in range(1, len(self._hosted)):
            assert self._team is not None
            yield FollowerJob(Follower(self._team, number))

    def prepare(self) -> None:
        """Whoever has led is dead, and so are those who followed."""
        if self._team is not None:
            self._team.forget()

    def perform(self, task: int, letter: Any) -> Any:
        """Do a task; the answer of those that have one."""
        if self._leader is None or task in ASKED:
            return self._perform(task, letter)
        with self._leader.order():
            return self._perform(task, letter)

    def _perform(self, task: int, letter: Any) -> Any:
        worlds = self._worlds
        if task == Task.STEP:
            worlds.step(self._commands)
        elif task == Task.RESET:
            worlds.reset(letter["seed"], letter["first_world"] + self._first)
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


class FollowerJob:
    """Some zones of one world, of which another worker has the rest.

    Args:
        follower: that runs their phases.
    """

    def __init__(self, follower: Follower) -> None:
        self._follower = follower

    def perform(self, task: int, letter: Any) -> None:
        """Help the leader to do a task."""
        self._follower.follow()

    def save(self) -> list[NDArray[Any]]:
        """Nothing: the leader keeps the state."""
        return []

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Nothing to do."""

    def prepare(self) -> None:
        """Nothing to do."""


def fingerprint(world: World) -> str:
    """What tells two readings of the same files apart, if somebody has changed one between."""
    made_of = (world.network, world.demand, world.partition)
    return " ".join("none" if part is None else part.content_hash for part in made_of)


def make_jobs(recipe: Mapping[str, Any]) -> list[Job]:
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
    jobs: list[Job] = []
    for part in (Part(*given) for given in recipe["parts"]):
        is_split = len(part.zones) > 1
        worlds = LocalWorlds(
            world,
            part.last - part.first,
            arrays.part(part.first, part.last),
            in_next_step=recipe["in_next_step"],
            zeros=shared_zeros if is_split else np.zeros,
        )
        leader = WorldsJob(worlds, part.first, part.zones if is_split else ())
        jobs += [leader, *leader.followers()]
    return jobs
