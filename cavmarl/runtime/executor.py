"""How the phases of a tick reach the shards."""

from __future__ import annotations

from typing import Any, Literal, Protocol

__all__ = ["Executor", "Phase"]

# What a tick is made of, by the names of methods of `ShardGroup` or `Shard`: a name and its
# arguments can be sent anywhere.
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
