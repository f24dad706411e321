"""What coordinator and zone hosts say to each other, and what the coordinator writes down.

A message carries its fences: the run, the episode, the tick, and the incarnation of the process
that it comes from or is meant for. Each entry about a vehicle carries the vehicle's epoch. States
of vehicles are opaque bytes with a digest; what stands in them is the runtime's affair.

The rule of the core: **write the records down, then send the messages** (`Output`).

A message or a record does not change once it is made. The classes are not frozen all the same: to
make a frozen one takes 2.4 µs instead of 0.4, and an idle tick of four zones makes twenty.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from cavmarl.ownership.ledger import OwnedTally

COORDINATOR = -1
"""Where messages to the coordinator go; zones are numbered from 0."""

RUN_BYTES = 16

_TO_COORDINATOR = (COORDINATOR,)


class Refusal(IntEnum):
    """Why a target does not hold a state."""

    LOAD = 1
    SCHEMA = 2
    DIGEST = 3


class In(NamedTuple):
    """The zone is to own the vehicle; with `forced` the state rides along."""

    vehicle: int
    epoch: int
    forced: bool
    digest: bytes
    state: bytes


class Out(NamedTuple):
    """The zone owns the vehicle no longer; `epoch` is the one that ends."""

    vehicle: int
    epoch: int


class Spawn(NamedTuple):
    """A new vehicle, at epoch 0."""

    vehicle: int
    state: bytes


class Offer(NamedTuple):
    """The state of a vehicle as of the tick of its message."""

    vehicle: int
    epoch: int
    digest: bytes
    state: bytes


class Held(NamedTuple):
    """The sender holds exactly that state."""

    vehicle: int
    epoch: int
    digest: bytes


class Withdrawn(NamedTuple):
    """The replica is no longer needed."""

    vehicle: int
    epoch: int


class Refused(NamedTuple):
    """The sender does not hold the state."""

    vehicle: int
    epoch: int
    reason: Refusal


class Confirmed(NamedTuple):
    """The vehicle that came IN has been advanced by its new owner."""

    vehicle: int
    epoch: int


class Removed(NamedTuple):
    """The vehicle has left the world; `reason` is the runtime's code."""

    vehicle: int
    reason: int


@dataclass(slots=True, unsafe_hash=True)
class Message:
    """What every message carries."""

    run: bytes  # 16 random bytes of this run
    episode: int  # counts the resets; messages of earlier episodes are void
    tick: int  # of the state that the message is about

    def destinations(self) -> tuple[int, ...]:
        """Zones, or COORDINATOR, that it goes to."""
        return _TO_COORDINATOR


@dataclass(slots=True, unsafe_hash=True)
class Step(Message):
    """C → Z: the lease to advance the owned vehicles to `tick`; it also says what is committed."""

    zone: int
    incarnation: int
    committed: int
    enter: tuple[In, ...] = ()
    leave: tuple[Out, ...] = ()
    spawn: tuple[Spawn, ...] = ()
    owned: OwnedTally = field(default_factory=OwnedTally)
    payload: bytes = b""

    def destinations(self) -> tuple[int, ...]:
        return (self.zone,)


@dataclass(slots=True, unsafe_hash=True)
class Done(Message):
    """Z → C: `tick` is in the store. `owned` counts after `removed`; `rows` is their digest."""

    zone: int
    incarnation: int
    confirmed: tuple[Confirmed, ...] = ()
    removed: tuple[Removed, ...] = ()
    owned: OwnedTally = field(default_factory=OwnedTally)
    rows: int = 0
    payload: bytes = b""


@dataclass(slots=True, unsafe_hash=True)
class Prepare(Message):
    """S → T: here are vehicles as of `tick`."""

    source: int
    incarnation: int
    target: int
    schema: int
    entries: tuple[Offer, ...]

    def destinations(self) -> tuple[int, ...]:
        return (self.target,)


@dataclass(slots=True, unsafe_hash=True)
class Abort(Message):
    """S → T: these approaches are over."""

    source: int
    incarnation: int
    target: int
    entries: tuple[Withdrawn, ...]

    def destinations(self) -> tuple[int, ...]:
        return (self.target,)


@dataclass(slots=True, unsafe_hash=True)
class Ack(Message):
    """T → C and S: `zone` holds exactly these states of `tick`."""

    zone: int
    incarnation: int
    source: int
    entries: tuple[Held, ...]

    def destinations(self) -> tuple[int, ...]:
        """The coordinator, and the source of the states."""
        return (COORDINATOR, self.source)


@dataclass(slots=True, unsafe_hash=True)
class Nack(Message):
    """T → C and S: `zone` does not hold these states."""

    zone: int
    incarnation: int
    source: int
    entries: tuple[Refused, ...]

    def destinations(self) -> tuple[int, ...]:
        """The coordinator, and the source of the states."""
        return (COORDINATOR, self.source)


@dataclass(slots=True, unsafe_hash=True)
class Need(Message):
    """Z → C: vehicles came IN without a matching replica; send their states."""

    zone: int
    incarnation: int
    vehicles: tuple[int, ...]


class Switch(NamedTuple):
    """A hand-off that begins; `epoch` is the new one."""

    vehicle: int
    source: int
    target: int
    epoch: int
    forced: bool


class Deferral(NamedTuple):
    """A vehicle stays with its source, for the `ticks`-th tick in a row."""

    vehicle: int
    ticks: int


class Birth(NamedTuple):
    """A vehicle that a zone begins to own."""

    vehicle: int
    zone: int
    state: bytes


class ZoneLedger(NamedTuple):
    """What a zone owned when a tick was committed, and the digest of its rows."""

    zone: int
    incarnation: int
    owned: OwnedTally
    rows: int


@dataclass(slots=True, unsafe_hash=True)
class Record:
    """A line of the coordinator's log."""

    episode: int
    tick: int


@dataclass(slots=True, unsafe_hash=True)
class Reset(Record):
    """An episode begins without vehicles; whatever was under way is void. First line of a log."""

    run: bytes


@dataclass(slots=True, unsafe_hash=True)
class Begin(Record):
    """What has been decided for the way to `tick`. `inputs` is the digest of the actions.

    `teleports` are the vehicles among `switches` whose new zone is no neighbour of the old one.
    """

    switches: tuple[Switch, ...] = ()
    deferred: tuple[Deferral, ...] = ()
    births: tuple[Birth, ...] = ()
    inputs: bytes = b""
    teleports: tuple[int, ...] = ()


@dataclass(slots=True, unsafe_hash=True)
class Commit(Record):
    """`tick` is the truth."""

    removed: tuple[Removed, ...] = ()
    zones: tuple[ZoneLedger, ...] = ()
    world: int = 0


@dataclass(slots=True, unsafe_hash=True)
class Fence(Record):
    """That process is dead to us."""

    zone: int
    incarnation: int


@dataclass(slots=True, unsafe_hash=True)
class Host(Record):
    """A new process of `worker` hosts the zone."""

    zone: int
    incarnation: int
    worker: int


@dataclass(slots=True, unsafe_hash=True)
class Output:
    """Records to write down, then messages to send."""

    records: tuple[Record, ...] = ()
    messages: tuple[Message, ...] = ()


Item: TypeAlias = Message | Record
