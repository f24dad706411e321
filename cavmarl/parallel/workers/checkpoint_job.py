"""`CheckpointJob`: the job of a worker that runs some worlds and keeps checkpoints of them."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

from numpy.typing import NDArray

from cavmarl.core.errors import SumoError
from cavmarl.parallel.state.checkpoint_log import CheckpointLog
from cavmarl.parallel.workers.worlds_job import WorldsJob
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import Task

AGAIN_S = 0.04  # a successor goes through no more steps again than take that long


class CheckpointJob(WorldsJob):
    def __init__(self, worlds: LocalWorlds, first: int, checkpoint_log: CheckpointLog) -> None:
        super().__init__(worlds, first)
        self._log = checkpoint_log
        self._logs = worlds.keep_logs()
        self._is_behind = False  # it is where the log begins, not where it ends
        self._lost: SumoError | None = None  # why it cannot get there
        self._again_s = 0.0  # that the steps of the log take

    def perform(self, task: int, payload: Any) -> Any:
        self._catch_up(task)
        if task not in (Task.STEP, Task.RESET, Task.LOAD):
            return super().perform(task, payload)
        if task != Task.STEP:
            super().perform(task, payload)
            self._begin_anew()
            return None
        self._note_step()
        began_s = perf_counter()
        super().perform(task, payload)
        self._again_s += perf_counter() - began_s
        return None

    def afterwards(self) -> None:
        """Write the image that the log begins anew with, if it is due; it is not waited for.

        Not in the order in which it began anew the last time: what is committed may still begin
        with the image before, whose place this one would take.
        """
        checkpoint_log = self._log
        is_there = not self._is_behind and self._lost is None
        if self._is_due and is_there and not checkpoint_log.is_prepared and len(checkpoint_log) > 1:
            checkpoint_log.prepare(self._worlds.save(), self._logs)

    @property
    def _is_due(self) -> bool:
        """Whether the log has to begin anew with the next step."""
        return self._log.is_full or self._again_s > AGAIN_S

    def _note_step(self) -> None:
        """Write down what the agents are about to do, in a log that begins anew if it is due."""
        if self._is_due:
            self._begin_anew(self._log.is_prepared)
        self._log.note(self._commands)

    def _begin_anew(self, is_prepared: bool = False) -> None:
        """Let the log begin with the present state, unless that is written already."""
        if not is_prepared:
            self._log.prepare(self._worlds.save(), self._logs)
        self._log.begin()
        self._again_s = 0.0

    def _catch_up(self, task: int) -> None:
        """Go through the steps of the log, if they are not behind it."""
        if self._lost is not None:
            error, self._lost = self._lost, None
            if task != Task.RESET or not self._worlds.arrays.chosen.all():
                raise error
        elif self._is_behind:
            self._is_behind = False
            began_s = perf_counter()
            for commands in self._log.steps():
                self._worlds.step(commands)
            self._again_s = perf_counter() - began_s

    def save(self) -> list[NDArray[Any]]:
        return [self._log.place]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Go on from what `save` gave; the steps since the last image wait for a task."""
        checkpoint_log, worlds = self._log, self._worlds
        checkpoint_log.go_to(saved[0])
        checkpoint_log.read_logs(self._logs)
        self._is_behind = True
        try:
            worlds.load(checkpoint_log.state(worlds.save()))
        except SumoError as error:
            self._lost, self._is_behind = error, False
