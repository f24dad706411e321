"""`ActionLogJob`: what a worker does that runs worlds with a journal or a plan of faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.parallel.checkpoint.action_log import ActionLog, LoggedAction
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.worlds_job import Task, WorldsJob


class ActionLogJob(WorldsJob):
    """Some of the worlds, next to each other, whose successor begins at their beginning.

    They are made where they run, not where workers are forked: a journal belongs to one process.
    """

    def __init__(self, make: Callable[[], LocalWorlds], first: int, tape: ActionLog) -> None:
        self._make = make
        self._first = first
        self._tape = tape
        self._count = np.zeros(1, dtype=np.int64)  # entries that the state follows from
        self._is_there = False  # where the tape ends

    def perform(self, task: int, letter: Any) -> Any:
        """Do a task; the answer of those that have one."""
        if not self._is_there:
            self._begin_anew()
        if task not in (Task.STEP, Task.RESET):
            return super().perform(task, letter)
        is_reset = task == Task.RESET
        seed = letter["seed"] if is_reset else None
        first_world = letter["first_world"] if is_reset else 0
        chosen = self._worlds.arrays.chosen
        count = self._count.item()
        self._tape.write(count, LoggedAction(is_reset, seed, first_world, chosen, self._commands))
        self._is_there = False
        super().perform(task, letter)
        self._count[0] = count + 1
        self._is_there = True
        return None

    def _begin_anew(self) -> None:
        self._end()
        self._take(self._make(), self._first)
        worlds = self._worlds
        chosen = worlds.arrays.chosen
        present = chosen.copy()  # of the command that waits
        for entry in self._tape.read(self._count.item()):
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
        """How much of the tape is committed."""
        return [self._count]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Go on from what `save` gave; the way there waits for a task."""
        self._count[:] = saved[0]
        self._is_there = False
