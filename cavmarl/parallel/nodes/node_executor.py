"""`NodeExecutor`: runs the phases of a tick on the zones of a node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cavmarl.engine.shard_clock import ShardClock
from cavmarl.shards.executor import PhaseExecutor
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Shard
from cavmarl.shards.shard_group import ShardGroup


class NodeExecutor(ShardGroup):
    """Runs phases on the shards of this node; other shards use the same buffers (sides) of rows."""

    def __init__(self, own: Sequence[Shard], foreign: Sequence[Shard]) -> None:
        super().__init__(own)
        self._foreign = foreign

    def turn(self) -> None:
        super().turn()
        self.align_foreign()

    def commit(self) -> None:
        super().commit()
        self.align_foreign()

    def align_foreign(self) -> None:
        """Set the side of the shards of other nodes to the side of the shards of this node."""
        side, next_side = self.sides
        for shard in self._foreign:
            if shard.side != side or shard.next_side != next_side:
                shard.set_sides(side, next_side)


class TimedNodeExecutor(PhaseExecutor):
    """A `NodeExecutor` that measures the time of each zone."""

    def __init__(self, plain: NodeExecutor, clock: ShardClock) -> None:
        self._plain, self._clock = plain, clock

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        """Run a phase, and measure its time."""
        self._clock.run(phase, arguments)
        if phase in (Phase.ADVANCE, Phase.COMMIT):
            self._plain.align_foreign()
