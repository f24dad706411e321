"""`WorldsJob`: the job of a worker that runs some of the worlds."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.processes.worker_loop import Job
from cavmarl.parallel.state.world_bytes import SavedWorlds
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import WORLD_TASKS, Task, commands_of


class WorldsJob(Job):
    """Some of the worlds, next to each other."""

    saved_worlds: SavedWorlds  # where they are left, and found, as bytes

    def __init__(self, worlds: LocalWorlds, first: int) -> None:
        self._take(worlds, first)

    def _take(self, worlds: LocalWorlds, first: int) -> None:
        self._worlds = worlds
        self._first = first
        self._commands = commands_of(worlds.arrays)

    def perform(self, task: int, payload: Any) -> Any:
        if task == Task.LOAD:
            payload = self.saved_worlds.take()
        found = WORLD_TASKS[Task(task)].perform(self._worlds, payload, self._first)
        if task == Task.SAVE:
            self.saved_worlds.put(found)
            return None
        return found

    def timed_step(self) -> NDArray[np.float64]:
        """Step; (W,) the processor time of each world, which share it by their vehicles."""
        began_ns = time.thread_time_ns()
        self._worlds.step(self._commands)
        spent_s = 1e-9 * (time.thread_time_ns() - began_ns)
        vehicles = self._worlds.simulation.running() + 1
        return np.asarray(vehicles * (spent_s / float(vehicles.sum())), dtype=np.float64)

    def save(self) -> list[NDArray[Any]]:
        return self._worlds.save()

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        self._worlds.load(saved)
