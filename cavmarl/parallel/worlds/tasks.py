"""Tasks of worlds in other processes: one table for workers and nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any, NamedTuple

from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.shards.shard import COMMANDS, Commands


class Task(IntEnum):
    """The tasks of a worker or a node."""

    STEP = 0
    RESET = 1
    SUGGEST = 2
    STATE_HASH = 3
    TRAFFIC_STATS = 4
    PACK = 5  # write the worlds that leave a worker to its outbox
    UNPACK = 6  # restart with the worlds that were kept and the new worlds
    HOST = 7  # run other zones
    WRITE_STATES = 8
    DRIVEN = 9
    SIGNAL_PHASES = 10
    SAVE = 11
    LOAD = 12
    LOADS = 13  # report the load of a node, of its machine, or its connections
    PROPOSE = 14  # propose zones with a better balance
    CUT = 15  # change the zones
    CHECK = 16  # check that saved worlds can be loaded
    COSTS = 17  # report the costs of zones


CHANGES = (Task.STEP, Task.RESET, Task.LOAD, Task.CUT)  # tasks that change worlds

TASK_NAMES = tuple(task.name.lower().replace("_", " ") for task in Task)


class WorldTask(NamedTuple):
    """How the process of the worlds carries out a task.

    Attributes:
        method: method of the worlds.
        read: converts the payload into keywords of the method. A payload names worlds by their
            numbers among all worlds; the second argument is the first world of this process.
        write: converts the returned value into the answer.
    """

    method: Callable[..., Any]
    read: Callable[[Any, int], dict[str, Any]]
    write: Callable[[Any], Any] = lambda found: found

    def perform(self, worlds: LocalWorlds, payload: Any, first: int = 0) -> Any:
        """Carry out the task with worlds whose numbers start at `first`."""
        return self.write(self.method(worlds, **self.read(payload, first)))


def commands_of(arrays: StepArrays) -> Commands:
    """Return the commands of the agents in the next step, as views."""
    return Commands(*(getattr(arrays, name) for name in COMMANDS))


def _step(worlds: LocalWorlds) -> None:
    worlds.step(commands_of(worlds.arrays))


def _nothing(payload: None, first: int) -> dict[str, Any]:
    return {}


def shifted_reset(payload: dict[str, Any], first: int) -> dict[str, Any]:
    """Return the payload of RESET for a process whose worlds have numbers from `first`."""
    return {**payload, "first_world": payload["first_world"] + first}


def _world(payload: int, first: int) -> dict[str, Any]:
    return {"world": payload - first}


def _agents(payload: tuple[int, list[int]], first: int) -> dict[str, Any]:
    return {"world": payload[0] - first, "agents": payload[1]}


def _saved(payload: list[bytes], first: int) -> dict[str, Any]:
    return {"saved": payload}


# Processes that pass saved worlds in another form handle SAVE, LOAD and CHECK themselves.
WORLD_TASKS: Mapping[Task, WorldTask] = {
    Task.STEP: WorldTask(_step, _nothing),
    Task.RESET: WorldTask(LocalWorlds.reset, shifted_reset),
    Task.SUGGEST: WorldTask(LocalWorlds.suggest, _nothing),
    Task.WRITE_STATES: WorldTask(LocalWorlds.write_states, _nothing),
    Task.STATE_HASH: WorldTask(LocalWorlds.state_hash, _world),
    Task.TRAFFIC_STATS: WorldTask(LocalWorlds.traffic_stats, _world),
    Task.DRIVEN: WorldTask(LocalWorlds.driven, _agents),
    Task.SIGNAL_PHASES: WorldTask(LocalWorlds.signal_phases, _world, lambda found: found.tolist()),
    Task.SAVE: WorldTask(LocalWorlds.save_worlds, _nothing),
    Task.LOAD: WorldTask(LocalWorlds.load_worlds, _saved),
    Task.CHECK: WorldTask(LocalWorlds.refusal, _saved),
}
