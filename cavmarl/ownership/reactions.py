"""What goes between a zone's endpoint and those around it, apart from messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from cavmarl.ownership.messages import Message, Spawn


@dataclass(slots=True)
class Hosting:
    """What a new host is told: its identity, and what its zone owns at the committed tick."""

    run: bytes
    episode: int
    tick: int
    zone: int
    incarnation: int
    owned: Mapping[int, int]  # vehicle → epoch


@dataclass(slots=True)
class Advance:
    """The shard's work for one tick: change the rows that are owned, then advance all of them."""

    episode: int  # when it changes, all earlier rows are void
    tick: int  # the tick to reach
    release: tuple[int, ...]  # rows kept from earlier switches, which may go or become ghosts now
    leave: tuple[int, ...]  # rows that are frozen as they are and kept
    enter: tuple[tuple[int, bytes], ...]  # (vehicle, state) of rows that come in
    spawn: tuple[Spawn, ...]  # new rows
    payload: bytes  # the STEP's own, for the runtime


@dataclass(slots=True)
class Reaction:
    """What a message leads to: messages to send, and with a new lease work for the shard."""

    messages: tuple[Message, ...] = ()
    advance: Advance | None = None
