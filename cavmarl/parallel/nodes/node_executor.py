"""`NodeExecutor`: runs the phases of a tick on the zones of a node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cavmarl.engine.shard_clock import ShardClock
from cavmarl.shards.executor import Executor, SerialExecutor
from cavmarl.shards.shard import Shard


class NodeExecutor:
    """Runs phases on the shards of this node; the other shards' rows stay on the same side."""

    def __init__(
        self, own: Sequence[Shard], foreign: Sequence[Shard], clock: ShardClock | None
    ) -> None:
        executor: Executor = clock or SerialExecutor(own)
        self._each = executor.each
        self._first, self._foreign = own[0], foreign

    def each(self, phase: str, *arguments: Any) -> None:
        self._each(phase, *arguments)
        if phase in ("advance", "commit"):
            side, next_side = self._first.side, self._first.next_side
            for shard in self._foreign:
                if (shard.side, shard.next_side) != (side, next_side):
                    shard.face(side, next_side)
