"""`ShardClock` measures the processor time of each shard."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.shards.executor import SerialExecutor
from cavmarl.shards.phases import PHASES
from cavmarl.shards.shard import Shard


class ShardClock:
    """Runs the phases of a tick zone by zone and adds up what each zone takes.

    What is done once for all zones (ghosts, the gate, signals, owners) is in no zone's time.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # one a zone, in the order of zones
        # one tick of so many is run zone by zone, and its time stands for the others. The first one
        # of them is not counted: it makes ready what the others use
        every: int = 1,
    ) -> None:
        self._hosts = [SerialExecutor((shard,)) for shard in shards]
        self._together = SerialExecutor(shards)
        self._every = every
        self._ticks = 0
        self._spent_ns = np.zeros(len(self._hosts), dtype=np.int64)

    def each(self, phase: str, *arguments: Any) -> None:
        self._ticks += phase == "advance"
        if self._ticks % self._every:
            self._together.each(phase, *arguments)
            return
        for zone, host in enumerate(self._hosts):
            began = time.thread_time_ns()
            host.each(phase, *arguments)
            if not PHASES[phase].is_beside and self._ticks > self._every:
                self._spent_ns[zone] += time.thread_time_ns() - began

    def take_s(self) -> NDArray[np.float64]:
        """Seconds of each zone since the last call, (k,)."""
        spent_s: NDArray[np.float64] = self._spent_ns.astype(np.float64) * (1e-9 * self._every)
        self._spent_ns[:] = 0
        return spent_s
