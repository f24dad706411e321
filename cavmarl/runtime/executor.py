"""How the phases of a tick reach the shards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol

from cavmarl.shard.shard import Shard

__all__ = ["Executor", "Phase", "SerialExecutor"]

# The methods of a shard that a tick is made of: a name and its arguments can be sent anywhere.
Phase = Literal[
    "begin_step",
    "advance",
    "choose_goals",
    "leave",
    "resolve",
    "rank_lanes",
    "propose",
    "admit",
    "commit",
    "detect",
    "sense",
    "credit",
    "suggest",
    "retire",
    "forget",
]


class Executor(Protocol):
    """Runs one phase on all shards and returns when all are through with it."""

    def each(self, phase: Phase, *arguments: Any) -> None:
        """Call the method `phase` of every shard with the same arguments."""
        ...


class SerialExecutor:
    """All shards in the caller's process, one after the other."""

    def __init__(self, shards: Sequence[Shard]) -> None:
        self._shards = tuple(shards)

    def each(self, phase: Phase, *arguments: Any) -> None:
        """Call the method `phase` of every shard, in order."""
        for shard in self._shards:
            getattr(shard, phase)(*arguments)
