"""How the phases of a tick reach the shards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from cavmarl.shard.shard import Shard

__all__ = ["Executor", "SerialExecutor"]


class Executor(Protocol):
    """Runs one phase on all shards and returns when all are through with it."""

    shards: Sequence[Shard]

    def each(self, phase: Callable[[Shard], None]) -> None:
        """Run `phase` on every shard."""
        ...


class SerialExecutor:
    """All shards in the caller's process, one after the other."""

    def __init__(self, shards: Sequence[Shard]) -> None:
        self.shards = tuple(shards)

    def each(self, phase: Callable[[Shard], None]) -> None:
        """Run `phase` on every shard, in order."""
        for shard in self.shards:
            phase(shard)
