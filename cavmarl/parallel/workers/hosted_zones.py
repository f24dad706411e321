"""`HostedZones`: the zones of a world that one worker of a team runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Shard
from cavmarl.shards.shard_group import ShardGroup

TIMED = 16  # one tick in 16 is run zone by zone and timed


class HostedZones:
    """Runs phases on the shards of its zones, which may change."""

    def __init__(
        self,
        shards: Sequence[Shard],  # shards of all zones of the world
        zones: Sequence[int],  # zones that this worker runs, maybe none
        # (k,) total processor time of each zone, updated; None: not measured
        spent_s: NDArray[np.float64] | None = None,
    ) -> None:
        self._all = shards
        self._spent_s = spent_s
        self._ticks = 0
        self.host(zones)

    def host(self, zones: Sequence[int]) -> None:
        """Run only these zones from now on."""
        self._shards = [self._all[zone] for zone in sorted(zones)]
        self._together = [ShardGroup(self._shards)] if self._shards else []
        self._alone: list[ShardGroup] = []
        self._untimed = -1  # tick in which the timed groups were made; its time does not count
        self._sides: tuple[int, int] | None = None  # buffers of rows, if known

    def set_sides(self, side: int, next_side: int) -> None:
        """Set the buffers of the committed and the next rows, as another process announced them."""
        if self._sides != (side, next_side):
            self._sides = side, next_side
            for shard in self._shards:
                shard.set_sides(side, next_side)

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        """Run a phase on the zones of this worker."""
        self._ticks += phase is Phase.MOVE
        if self._spent_s is not None and self._ticks % TIMED == 0:
            self._run_timed(self._spent_s, phase, arguments)
            return
        for group in self._together:
            phase.run(group, arguments)

    def _run_timed(
        self, spent_s: NDArray[np.float64], phase: Phase, arguments: tuple[Any, ...]
    ) -> None:
        """Run a phase zone by zone; the time counts for all ticks until the next timed tick."""
        if not self._alone:
            self._alone = [ShardGroup([shard]) for shard in self._shards]
            self._untimed = self._ticks  # the first run of new groups also loads their kernels
        for shard, group in zip(self._shards, self._alone, strict=True):
            began_ns = time.thread_time_ns()
            phase.run(group, arguments)
            if self._ticks != self._untimed:
                spent_s[shard.zone] += TIMED * 1e-9 * (time.thread_time_ns() - began_ns)
