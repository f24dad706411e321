"""`LoggedWorlds`: worlds with a checkpoint log, by which they survive the death of their worker."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

from numpy.typing import NDArray

from cavmarl.core.errors import SumoError
from cavmarl.parallel.state.checkpoint_log import CheckpointLog
from cavmarl.parallel.workers.worker_worlds import WorkerWorlds
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import Task

MAX_REPEAT_S = 0.04  # limit on the time that a successor needs to repeat the steps of the log


class LoggedWorlds(WorkerWorlds):
    """Worlds whose state is the image at the start of a log, followed by the steps of the log."""

    def __init__(
        self,
        worlds: LocalWorlds,
        first: int,
        checkpoint_log: CheckpointLog,
        # whether `MAX_REPEAT_S` limits the log. If a team runs the world, a step takes long, and an
        # image takes almost as long, so the log is limited only by the number of steps.
        limits_repeat: bool,
    ) -> None:
        super().__init__(worlds, first)
        self._log = checkpoint_log
        self._sumo_logs = worlds.keep_logs()
        self._limits_repeat = limits_repeat
        self._is_behind = False  # whether the worlds are at the start of the log, not at its end
        self._lost: SumoError | None = None  # why the worlds cannot reach the end of the log
        self._repeat_s = 0.0  # duration of the steps in the log

    def before(self, task: Task) -> None:
        """Repeat the steps of the log, if the worlds are behind it.

        Raises:
            SumoError: the state cannot be restored, and the task does not reset all worlds.
        """
        if self._lost is not None:
            error, self._lost = self._lost, None
            if task != Task.RESET or not self.worlds.arrays.chosen.all():
                raise error
        elif self._is_behind:
            self._is_behind = False
            began_s = perf_counter()
            for commands in self._log.steps():
                self.worlds.step(commands)
            self._repeat_s = perf_counter() - began_s

    def step(self) -> None:
        if self._is_full:
            self._restart_log(self._log.is_prepared)
        self._log.note(self.commands)
        began_s = perf_counter()
        super().step()
        if self._limits_repeat:
            self._repeat_s += perf_counter() - began_s

    def after(self, task: Task) -> None:
        if task in (Task.RESET, Task.LOAD):
            self._restart_log()

    def on_idle(self) -> None:
        """Write the next image, if it is due, while the pool does not wait for this worker.

        The log does not write two images in a row: the committed state may still start with the
        previous image, which the new image would overwrite.
        """
        checkpoint_log = self._log
        is_current = not self._is_behind and self._lost is None
        if self._is_full and is_current and not checkpoint_log.is_prepared:
            if len(checkpoint_log) > 1:
                checkpoint_log.prepare(self.worlds.save(), self._sumo_logs)

    @property
    def _is_full(self) -> bool:
        """True if the log has to restart with the next step."""
        return self._log.is_full or self._repeat_s > MAX_REPEAT_S

    def _restart_log(self, is_prepared: bool = False) -> None:
        """Let the log start with the current state, whose image may have been written already."""
        if not is_prepared:
            self._log.prepare(self.worlds.save(), self._sumo_logs)
        self._log.begin()
        self._repeat_s = 0.0

    def save(self) -> list[NDArray[Any]]:
        return [self._log.place]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Resume from the image; the steps after it are repeated before the next task."""
        checkpoint_log, worlds = self._log, self.worlds
        checkpoint_log.go_to(saved[0])
        checkpoint_log.read_logs(self._sumo_logs)
        self._is_behind = True
        try:
            worlds.load(checkpoint_log.state(worlds.save()))
        except SumoError as error:
            self._lost, self._is_behind = error, False
