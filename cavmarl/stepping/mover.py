"""`Mover`: lets worlds, or zones of split worlds, change their worker while worlds are stepped."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from cavmarl.errors import WorkerStartError
from cavmarl.runtime.shared_memory import Segment, arrays_in, size_of
from cavmarl.stepping.job import Task
from cavmarl.stepping.parts import Part, parts_of
from cavmarl.stepping.placement import Placement

__all__ = ["Mover"]

_CASE_BYTES = 1 << 12  # of what a worker leaves for others; it grows

Run = Callable[[Task, Any, bool], None]


class Mover:
    """Measures shards, plans anew from time to time, and has moved what the plans move.

    Args:
        placement: the plans.
        num_worlds: W.
        num_zones: of each world.
        workers: how many.
        every: so many steps from one round to the next.

    Attributes:
        segments: memory for the workers.
        recipe: what they are told about it.
        moves: of shards, up to now.
        moved_s: how long they have taken together.

    Raises:
        WorkerStartError: there is no memory.
    """

    def __init__(
        self, placement: Placement, num_worlds: int, num_zones: int, workers: int, every: int
    ) -> None:
        self._placement = placement
        self._num_zones = num_zones
        self._every = every
        self._steps = 0
        self.moves = 0
        self.moved_s = 0.0
        layout = {"spent_s": ("<f8", (num_worlds, 1 if placement.in_row else num_zones))}
        self.segments = [Segment.make(size_of(layout))]
        try:
            if placement.in_row:
                self.segments += [Segment.make(_CASE_BYTES) for _ in range(workers)]
            self._spent_s = arrays_in(self.segments[0].map(), layout)["spent_s"]
        except WorkerStartError:
            for segment in self.segments:
                segment.close()
            raise
        spent, *cases = (segment.fd for segment in self.segments)
        self.recipe = {"spent": spent, "layout": layout, "cases": cases}

    def before_step(self, run: Run, pids: Callable[[], Mapping[int, int]]) -> list[Part] | None:
        """Count a step; if it is time, plan anew and move.

        Args:
            run: lets all workers do a task.
            pids: tells those of their processes.

        Returns:
            who runs what now; None: what they did before.
        """
        if self._steps < self._every:
            self._steps += 1
            return None
        before = self._placement.plans
        moves = self._placement.round(self._spent_s, self._steps, pids())
        self._steps = 1
        if not moves:
            return None
        parts = parts_of(self._placement.plans, self._num_zones)
        began = time.perf_counter()
        try:
            self._order(run, parts)
        except BaseException:
            self._placement.take_back(before)
            raise
        lasted_s = time.perf_counter() - began
        self.moves += self._placement.moved(lasted_s)
        self.moved_s += lasted_s
        return parts

    def _order(self, run: Run, parts: list[Part]) -> None:
        if not self._placement.in_row:
            run(Task.HOST, [part.zones for part in parts], True)
            return
        bounds = [part.first for part in parts] + [parts[-1].last]
        run(Task.PACK, bounds, False)
        run(Task.UNPACK, bounds, True)
