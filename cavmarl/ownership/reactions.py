"""Data that a zone's endpoint exchanges with its shard and its process, besides messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from cavmarl.ownership.messages import Message, Spawn


@dataclass(slots=True)
class Hosting:
    """The identity of a new host, and the vehicles of its zone at the committed tick."""

    run: bytes
    episode: int
    tick: int
    zone: int
    incarnation: int
    owned: Mapping[int, int]  # vehicle → epoch


@dataclass(slots=True)
class Advance:
    """The shard's work for one tick: change the set of owned rows, then advance all of them."""

    episode: int  # a new episode makes all earlier rows invalid
    tick: int  # the tick to reach
    release: tuple[int, ...]  # rows of committed switches, which may be dropped or become ghosts
    leave: tuple[int, ...]  # rows that are frozen and kept
    enter: tuple[tuple[int, bytes], ...]  # (vehicle, state) of rows that enter the zone
    spawn: tuple[Spawn, ...]  # new rows
    payload: bytes  # payload of the STEP, for the runtime


@dataclass(slots=True)
class Reaction:
    """The response to a message: messages to send and, with a new lease, work for the shard."""

    messages: tuple[Message, ...] = ()
    advance: Advance | None = None
