"""`WorkerWorlds`: the worlds that a worker process runs, and how they survive its death."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import Task, commands_of


class WorkerWorlds:
    """Worlds with consecutive numbers, and the state from which a successor resumes them.

    Attributes:
        worlds: the worlds.
        first: number of the first of these worlds among all worlds.
        commands: commands of their agents in the next step, as views of the step arrays.
        tasks: tasks that these worlds support in addition to `WORLD_TASKS`.
    """

    tasks: Mapping[Task, Callable[[Any], None]]

    def __init__(self, worlds: LocalWorlds, first: int) -> None:
        self.tasks = {}
        self.use(worlds, first)

    def use(self, worlds: LocalWorlds, first: int) -> None:
        """Run these worlds from now on."""
        self.worlds = worlds
        self.first = first
        self.commands = commands_of(worlds.arrays)

    def before(self, task: Task) -> None:
        """Prepare the worlds for a task of `WORLD_TASKS`."""

    def step(self) -> None:
        self.worlds.step(self.commands)

    def after(self, task: Task) -> None:
        """Finish a task of `WORLD_TASKS` that succeeded."""

    def on_idle(self) -> None:
        """See `Job.on_idle`."""

    def save(self) -> list[NDArray[Any]]:
        """Return the state from which a successor can resume the worlds."""
        return self.worlds.save()

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Resume from what `save` returned."""
        self.worlds.load(saved)
