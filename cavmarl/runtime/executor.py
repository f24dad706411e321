"""How the phases of a tick reach the shards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from cavmarl.shard.shard import Shard

__all__ = ["Executor", "SerialExecutor"]


class Executor(Protocol):
    """Runs one phase on all shards and returns when all are through with it."""

    @property
    def shards(self) -> Sequence[Shard]:
        """The shards, in the order of their zones."""
        ...

    def each(self, phase: Callable[[Shard], None]) -> None:
        """Run `phase` on every shard."""
        ...


class SerialExecutor:
    """All shards in the caller's process, one after the other."""

    def __init__(self, shards: Sequence[Shard]) -> None:
        self._shards = tuple(shards)

    @property
    def shards(self) -> Sequence[Shard]:
        """The shards, in the order of their zones."""
        return self._shards

    def each(self, phase: Callable[[Shard], None]) -> None:
        """Run `phase` on every shard, in order."""
        for shard in self._shards:
            phase(shard)
