"""`Mover`: moves worlds, or zones of split worlds, to other workers between steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.core.errors import WorkerError
from cavmarl.parallel.memory.shared_memory import Segment, arrays_in, size_of
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.parallel.placement.work_shares import Part, parts_of
from cavmarl.parallel.worlds.tasks import Task

_OUTBOX_BYTES = 1 << 12  # initial size of an outbox, where a worker puts worlds that leave it

Run = Callable[[Task, Any, bool], None]


class Mover:
    """Counts steps; every `every` steps, makes new plans and moves worlds or zones accordingly."""

    def __init__(
        self,
        placement: StepPlacement,  # the plans
        num_zones: int,  # number of zones of each world
        every: int,  # steps from one round of balancing to the next
        # (W, zones) total processor time of each shard in s, which the workers update; if whole
        # worlds are placed, each world has one column
        spent_s: NDArray[np.float64],
    ) -> None:
        self._placement = placement
        self._num_zones = num_zones
        self._every = every
        self._spent_s = spent_s
        self._steps = 0
        self.moves = 0  # number of moved shards so far
        self.moved_s = 0.0  # total duration of the moves

    def before_step(
        self,
        run: Run,
        seen: Callable[[], LoadSnapshot],  # measures how busy workers are
    ) -> list[Part] | None:
        """Count a step; if a round is due, make new plans and move.

        Returns:
            the new part of each worker; None: nothing has moved.
        """
        if self._steps < self._every:
            self._steps += 1
            return None
        before = self._placement.plans
        snapshot = seen()  # `seen` may update `spent_s`
        moves = self._placement.round(self._spent_s, self._steps, snapshot)
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


class MovingMemory:
    """Shared memory for the costs of shards, and the outboxes of workers with whole worlds.

    Attributes:
        message: the part of the message to workers that describes the memory.
        spent_s: (W, zones) total processor time of each shard.

    Raises:
        WorkerError: there is not enough memory.
    """

    def __init__(
        self,
        num_worlds: int,  # W
        num_zones: int,  # number of zones of each world; 1 if whole worlds are placed
        outboxes: int,
    ) -> None:
        layout = {"spent_s": ("<f8", (num_worlds, num_zones))}
        self.segments = [Segment.make(size_of(layout))]  # the memory
        try:
            self.segments += [Segment.make(_OUTBOX_BYTES) for _ in range(outboxes)]
            self.spent_s = arrays_in(self.segments[0].map(), layout)["spent_s"]
        except WorkerError:
            for segment in self.segments:
                segment.close()
            raise
        spent, *others = (segment.fd for segment in self.segments)
        self.message = {"spent": spent, "layout": layout, "outboxes": others}
