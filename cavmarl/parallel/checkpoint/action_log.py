"""`ActionLog` records all inputs of some worlds since they were made; `ActionLogJob` keeps one.

A checkpoint log keeps images, and ownership is in none of them: a successor gives each vehicle to
the zone that it is in. That changes no result, but a journal would tell of it. So the successor of
worlds with a journal goes through everything again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import WorkerError
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.tasks import Task
from cavmarl.parallel.worlds_job import WorldsJob
from cavmarl.shards.shard import COMMANDS, Commands

_READ_AT_ONCE = 64  # entries


class LoggedAction(NamedTuple):
    is_reset: bool  # or else a step
    seed: int | None  # of a reset; None: none was given
    first_world: int  # of a reset, as the command has it
    chosen: NDArray[np.bool_]  # (W,) which worlds a reset is about
    commands: Commands  # of the agents in a step


class ActionLog:
    """Entries one behind the other, in memory that outlives its writers."""

    def __init__(
        self,
        fd: int,  # of that memory, which grows
        like: Commands,  # what agents do, in arrays of the shapes and dtypes that they always have
    ) -> None:
        self._fd = fd
        worlds = len(like.controls)
        fields: list[tuple[str, str, tuple[int, ...]]] = [
            ("is_reset", "|b1", ()),
            ("has_seed", "|b1", ()),
            ("seed", "<i8", ()),
            ("first_world", "<i8", ()),
            ("chosen", "|b1", (worlds,)),
        ]
        for name in COMMANDS:
            array = getattr(like, name)
            fields.append((name, array.dtype.str, array.shape))
        self._row = np.zeros(1, dtype=np.dtype(fields))
        self._commands = Commands(*(np.zeros_like(getattr(like, name)) for name in COMMANDS))

    def write(self, number: int, entry: LoggedAction) -> None:
        """Put down an entry, in the place of that and all later ones."""
        row = self._row
        row["is_reset"], row["has_seed"] = entry.is_reset, entry.seed is not None
        row["seed"], row["first_world"] = entry.seed or 0, entry.first_world
        row["chosen"] = entry.chosen
        for name in COMMANDS:
            row[name] = getattr(entry.commands, name)
        try:
            os.pwrite(self._fd, row.tobytes(), number * row.itemsize)
        except OSError as error:
            raise WorkerError(
                f"no memory for what worlds with a journal are told ({error.strerror}): "
                "make the environment anew now and then, or use workers=0"
            ) from error

    def read(self, count: int) -> Iterator[LoggedAction]:
        """The first so many entries; the commands of one are overwritten by the next."""
        size = self._row.itemsize
        for first in range(0, count, _READ_AT_ONCE):
            some = min(count - first, _READ_AT_ONCE)
            raw = os.pread(self._fd, some * size, first * size)
            for row in np.frombuffer(raw, dtype=self._row.dtype):
                for name in COMMANDS:  # whose arrays kernels know: aligned and writable
                    getattr(self._commands, name)[...] = row[name]
                seed = int(row["seed"]) if row["has_seed"] else None
                is_reset, first_world = bool(row["is_reset"]), int(row["first_world"])
                yield LoggedAction(is_reset, seed, first_world, row["chosen"], self._commands)


class ActionLogJob(WorldsJob):
    """Some of the worlds, next to each other, whose successor begins at their beginning.

    They are made where they run, not where workers are forked: a journal belongs to one process.
    """

    def __init__(self, make: Callable[[], LocalWorlds], first: int, actions: ActionLog) -> None:
        self._make = make
        self._first = first
        self._actions = actions
        self._count = np.zeros(1, dtype=np.int64)  # entries that the state follows from
        self._is_there = False  # where the log of actions ends

    def perform(self, task: int, payload: Any) -> Any:
        if not self._is_there:
            self._begin_anew()
        if task not in (Task.STEP, Task.RESET):
            return super().perform(task, payload)
        is_reset = task == Task.RESET
        seed = payload["seed"] if is_reset else None
        first_world = payload["first_world"] if is_reset else 0
        chosen = self._worlds.arrays.chosen
        count = self._count.item()
        self._actions.write(
            count, LoggedAction(is_reset, seed, first_world, chosen, self._commands)
        )
        self._is_there = False
        super().perform(task, payload)
        self._count[0] = count + 1
        self._is_there = True
        return None

    def _begin_anew(self) -> None:
        self._end()
        self._take(self._make(), self._first)
        worlds = self._worlds
        chosen = worlds.arrays.chosen
        present = chosen.copy()  # of the command that waits
        for entry in self._actions.read(self._count.item()):
            if entry.is_reset:
                chosen[:] = entry.chosen
                worlds.reset(entry.seed, entry.first_world + self._first)
            else:
                worlds.step(entry.commands)
        chosen[:] = present
        self._is_there = True

    def _end(self) -> None:
        """Let go what the worlds of this process hold, if there are any."""
        if not hasattr(self, "_worlds"):
            return
        for coordinator in self._worlds.simulation.coordinators:
            if isinstance(coordinator.journal, Journal):
                coordinator.journal.close()
        self._worlds.close()

    def save(self) -> list[NDArray[Any]]:
        """How much of the log is committed."""
        return [self._count]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Go on from what `save` gave; the way there waits for a task."""
        self._count[:] = saved[0]
        self._is_there = False
