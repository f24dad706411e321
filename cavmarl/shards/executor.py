"""How the phases of a tick reach the shards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from cavmarl.shards.shard import Shard
from cavmarl.shards.shard_group import ShardGroup


class Executor(Protocol):
    """Runs one phase on all shards and returns when all are through with it."""

    def each(self, phase: str, *arguments: Any) -> None:
        """Run the phase on every shard with the same arguments; see `ShardGroup`."""
        ...


class Together(Executor, Protocol):
    """Several that run phases side by side; after some the first of them does not wait."""

    def meet(self) -> None:
        """Wait until all shards are through with the last phase."""
        ...


class SerialExecutor:
    """Shards in the caller's process, all of them or some, as one group."""

    def __init__(self, shards: Sequence[Shard]) -> None:
        self.each: Callable[..., None] = ShardGroup(shards).each
