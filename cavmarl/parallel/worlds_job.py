"""`WorldsJob`: the job of a worker that runs some of the worlds."""

from __future__ import annotations

import time
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.checkpoint.world_bytes import SavedWorlds
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.processes.worker_loop import Job
from cavmarl.parallel.step_arrays import StepArrays
from cavmarl.shards.shard import Commands


class Task(IntEnum):
    """What a worker can be asked for."""

    STEP = 0
    RESET = 1
    SUGGEST = 2
    STATE_HASH = 3
    TRAFFIC_STATS = 4
    PACK = 5
    UNPACK = 6
    HOST = 7
    WRITE_STATES = 8
    DRIVEN = 9
    SIGNAL_PHASES = 10
    SAVE = 11
    LOAD = 12
    LOADS = 13
    PROPOSE = 14
    CUT = 15


TASK_NAMES = tuple(task.name.lower().replace("_", " ") for task in Task)


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
        worlds = self._worlds
        if task == Task.STEP:
            worlds.step(self._commands)
        elif task == Task.RESET:
            worlds.reset(payload["seed"], payload["first_world"] + self._first)
        elif task == Task.SUGGEST:
            worlds.suggest()
        elif task == Task.WRITE_STATES:
            worlds.write_states()
        elif task == Task.STATE_HASH:
            return worlds.state_hash(payload - self._first)
        elif task == Task.TRAFFIC_STATS:
            return worlds.traffic_stats(payload - self._first)
        elif task == Task.DRIVEN:
            return worlds.driven(payload[0] - self._first, payload[1])
        elif task == Task.SIGNAL_PHASES:
            return worlds.signal_phases(payload - self._first).tolist()
        elif task == Task.SAVE:
            self.saved_worlds.put(worlds.save_worlds())
        elif task == Task.LOAD:
            worlds.load_worlds(self.saved_worlds.take())
        return None

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


def commands_of(arrays: StepArrays) -> Commands:
    """What agents do in the next step; views."""
    return Commands(arrays.controls, arrays.meta_actions, arrays.declared, arrays.inserted)
