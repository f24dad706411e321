"""`ShardClock` measures the processor time of each shard."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.shards.executor import PhaseExecutor
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Shard
from cavmarl.shards.shard_group import ShardGroup


class ShardClock(PhaseExecutor):
    """An executor that runs the phases of a tick zone by zone and sums the time of each zone.

    Work that is done once for all zones (ghosts, the departure queue, signals, ownership) counts
    for no zone.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # one per zone, in the order of zones
        # One tick in `every` ticks is run zone by zone, and its time counts for all of them. The
        # first measured tick is not counted, because it also binds the calls.
        every: int = 1,
    ) -> None:
        self._alone = [ShardGroup((shard,)) for shard in shards]
        self._together = ShardGroup(shards)
        self._every = every
        self._ticks = 0
        self._spent_ns = np.zeros(len(self._alone), dtype=np.int64)

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        """Run a phase on all shards; in measured ticks, shard by shard."""
        self._ticks += phase is Phase.ADVANCE
        if self._ticks % self._every:
            phase.run(self._together, arguments)
            return
        for zone, group in enumerate(self._alone):
            began = time.thread_time_ns()
            phase.run(group, arguments)
            if not phase.value.is_beside and self._ticks > self._every:
                self._spent_ns[zone] += time.thread_time_ns() - began

    def take_s(self) -> NDArray[np.float64]:
        """Return the seconds (k,) of each zone since the last call, and reset them."""
        spent_s: NDArray[np.float64] = self._spent_ns.astype(np.float64) * (1e-9 * self._every)
        self._spent_ns[:] = 0
        return spent_s
