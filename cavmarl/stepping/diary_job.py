"""`DiaryJob`: what a worker does that runs some of the worlds and keeps a diary of them."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

from numpy.typing import NDArray

from cavmarl.errors import SumoStateError
from cavmarl.stepping.diary import Diary
from cavmarl.stepping.job import Task, WorldsJob
from cavmarl.stepping.local import LocalWorlds

__all__ = ["DiaryJob"]

AGAIN_S = 0.04  # a successor goes through no more steps again than take that long


class DiaryJob(WorldsJob):
    """Some of the worlds, next to each other.

    Args:
        worlds: that write their part of the shared arrays.
        first: number of the first one among all.
        diary: in which they leave their state behind.
    """

    def __init__(self, worlds: LocalWorlds, first: int, diary: Diary) -> None:
        super().__init__(worlds, first)
        self._diary = diary
        self._logs = worlds.keep_logs()
        self._is_behind = False  # it is where the diary begins, and not where that ends
        self._lost: SumoStateError | None = None  # why it cannot get there
        self._again_s = 0.0  # that the steps of the diary take

    def perform(self, task: int, letter: Any) -> Any:
        """Do a task; the answer of those that have one."""
        self._catch_up(task)
        if task not in (Task.STEP, Task.RESET):
            return super().perform(task, letter)
        diary = self._diary
        begins_anew = task == Task.RESET or diary.is_full or self._again_s > AGAIN_S
        if not begins_anew:
            diary.note(self._commands)
        began_s = perf_counter()
        super().perform(task, letter)
        self._again_s += perf_counter() - began_s
        if begins_anew:
            diary.begin(self._worlds.save(), self._logs)
            self._again_s = 0.0
        return None

    def _catch_up(self, task: int) -> None:
        """Go through the steps of the diary, if they are not behind it.

        Raises:
            SumoStateError: as of `Simulation.load`; but all worlds may be reset.
        """
        if self._lost is not None:
            error, self._lost = self._lost, None
            if task != Task.RESET or not self._worlds.arrays.chosen.all():
                raise error
        elif self._is_behind:
            self._is_behind = False
            began_s = perf_counter()
            for commands in self._diary.steps():
                self._worlds.step(commands)
            self._again_s = perf_counter() - began_s

    def save(self) -> list[NDArray[Any]]:
        """Where to begin in the diary."""
        return [self._diary.place]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Go on from what `save` gave; the steps since the last image wait for a task."""
        diary, worlds = self._diary, self._worlds
        diary.place[:] = saved[0]
        diary.read_logs(self._logs)
        self._is_behind = True
        try:
            worlds.load(diary.state(worlds.save()))
        except SumoStateError as error:
            self._lost, self._is_behind = error, False
