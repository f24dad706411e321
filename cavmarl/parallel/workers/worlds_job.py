"""`WorldsJob`: the job of a worker that runs some of the worlds."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

from numpy.typing import NDArray

from cavmarl.parallel.processes.worker_loop import Job
from cavmarl.parallel.state.world_bytes import SavedWorlds
from cavmarl.parallel.workers.team_job import LedTeam
from cavmarl.parallel.workers.worker_worlds import WorkerWorlds
from cavmarl.parallel.worlds.tasks import WORLD_TASKS, Task


class WorldsJob(Job):
    """Runs worlds; with a team, a single world whose zones its members share."""

    def __init__(
        self,
        kept: WorkerWorlds,
        saved_worlds: SavedWorlds,  # memory through which SAVE and LOAD pass worlds
        team: LedTeam | None = None,
    ) -> None:
        self._kept = kept
        self._saved_worlds = saved_worlds
        self._team = team
        self._own_tasks = kept.tasks if team is None else {**kept.tasks, Task.HOST: team.host}

    def perform(self, task: int, payload: Any) -> Any:
        task = Task(task)
        if task in self._own_tasks:
            self._own_tasks[task](payload)
            return None
        kept, team = self._kept, self._team
        with nullcontext() if team is None else team.command(task):
            kept.before(task)
            if team is not None:
                team.end_with(task)
            answer = self._perform(task, payload)
        kept.after(task)
        return answer

    def _perform(self, task: Task, payload: Any) -> Any:
        if task == Task.STEP:
            self._kept.step()
            return None
        if task == Task.LOAD:
            payload = self._saved_worlds.read()
        answer = WORLD_TASKS[task].perform(self._kept.worlds, payload, self._kept.first)
        if task != Task.SAVE:
            return answer
        self._saved_worlds.write(answer)
        return None

    def save(self) -> list[NDArray[Any]]:
        """Return the state of the worlds, and for a team the host of each zone."""
        kept = self._kept.save()
        return kept if self._team is None else [*kept, self._team.hosts]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        if self._team is not None:
            *saved, hosts = saved
            self._team.set_hosts(hosts)
        self._kept.load(saved)

    def on_idle(self) -> None:
        self._kept.on_idle()

    def before_fork(self) -> None:
        if self._team is not None:
            self._team.forget()
