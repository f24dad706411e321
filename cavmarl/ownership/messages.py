"""The messages between coordinator and zone hosts, and the records of the coordinator's log.

C is the coordinator, Z a zone host, S the source and T the target of a hand-off. A message states
its run, its episode, its tick, and the incarnation of the sending or receiving host, so that
outdated messages can be dropped. Each entry about a vehicle has the vehicle's epoch. States of
vehicles are opaque bytes with a digest; only the runtime (the program around this package) reads
them. docs/explanation/ownership.md defines all terms.

The rule of this package: **store the records, then send the messages** (`Output`).

Messages and records are never changed. Their classes are not frozen, because a frozen instance
takes 2.4 µs to make instead of 0.4 µs, and an idle tick of four zones makes twenty of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from cavmarl.ownership.ledger import OwnedTally

COORDINATOR = -1
"""The destination of messages to the coordinator; zones are numbered from 0."""

RUN_BYTES = 16

_TO_COORDINATOR = (COORDINATOR,)


class Refusal(IntEnum):
    """The reason why a target refuses a state."""

    LOAD = 1  # the target has no room for another replica
    SCHEMA = 2  # the state has another version
    DIGEST = 3  # the state does not match its digest
    SIMULATOR = 4  # the simulator that runs the zone does not accept the vehicle now


class In(NamedTuple):
    """An order to own the vehicle; with `forced`, its state is attached."""

    vehicle: int
    epoch: int
    forced: bool
    digest: bytes
    state: bytes


class Out(NamedTuple):
    """An order to give up the vehicle; `epoch` is the epoch of the ownership that ends."""

    vehicle: int
    epoch: int


class Spawn(NamedTuple):
    """A new vehicle, at epoch 0."""

    vehicle: int
    state: bytes


class Offer(NamedTuple):
    """The state of a vehicle at the tick of its message."""

    vehicle: int
    epoch: int
    digest: bytes
    state: bytes


class Held(NamedTuple):
    """A confirmation that the sender has exactly this state."""

    vehicle: int
    epoch: int
    digest: bytes


class Withdrawn(NamedTuple):
    """A notice that the replica is not needed."""

    vehicle: int
    epoch: int


class Refused(NamedTuple):
    """A notice that the sender refuses the state."""

    vehicle: int
    epoch: int
    reason: Refusal


class Confirmed(NamedTuple):
    """A confirmation that the new owner has advanced the vehicle of an IN."""

    vehicle: int
    epoch: int


class Removed(NamedTuple):
    """A vehicle that has left the world; `reason` is the runtime's code."""

    vehicle: int
    reason: int


@dataclass(slots=True, unsafe_hash=True)
class Message:
    """The fields of every message."""

    run: bytes  # 16 random bytes of this run
    episode: int  # counts the resets; messages of earlier episodes are void
    tick: int  # tick of the state that the message is about

    def destinations(self) -> tuple[int, ...]:
        """Return the destinations: zones or COORDINATOR."""
        return _TO_COORDINATOR


@dataclass(slots=True, unsafe_hash=True)
class Step(Message):
    """C → Z: a lease to advance the owned vehicles to `tick`; `committed` is the committed tick."""

    zone: int
    incarnation: int
    committed: int
    enter: tuple[In, ...] = ()
    leave: tuple[Out, ...] = ()
    spawn: tuple[Spawn, ...] = ()
    owned: OwnedTally = field(default_factory=OwnedTally)  # what the zone owns after these changes
    payload: bytes = b""  # only the runtime reads it

    def destinations(self) -> tuple[int, ...]:
        return (self.zone,)


@dataclass(slots=True, unsafe_hash=True)
class Done(Message):
    """Z → C: the zone has stored its vehicles at `tick`."""

    zone: int
    incarnation: int
    confirmed: tuple[Confirmed, ...] = ()
    removed: tuple[Removed, ...] = ()
    owned: OwnedTally = field(default_factory=OwnedTally)  # what the zone owns after removals
    rows: int = 0  # digest of the rows of these vehicles
    payload: bytes = b""  # only the runtime reads it


@dataclass(slots=True, unsafe_hash=True)
class Prepare(Message):
    """S → T: the states of vehicles at `tick`."""

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
    """T → C and S: `zone` has exactly these states of `tick`."""

    zone: int
    incarnation: int
    source: int
    entries: tuple[Held, ...]

    def destinations(self) -> tuple[int, ...]:
        """Return the coordinator and the source of the states."""
        return (COORDINATOR, self.source)


@dataclass(slots=True, unsafe_hash=True)
class Nack(Message):
    """T → C and S: `zone` refuses these states."""

    zone: int
    incarnation: int
    source: int
    entries: tuple[Refused, ...]

    def destinations(self) -> tuple[int, ...]:
        """Return the coordinator and the source of the states."""
        return (COORDINATOR, self.source)


@dataclass(slots=True, unsafe_hash=True)
class Need(Message):
    """Z → C: the zone has no replicas of these vehicles of IN; send their states."""

    zone: int
    incarnation: int
    vehicles: tuple[int, ...]


class Switch(NamedTuple):
    """A change of owner; `epoch` is the epoch of the new ownership."""

    vehicle: int
    source: int
    target: int
    epoch: int
    forced: bool


class Deferral(NamedTuple):
    """A vehicle beyond a border stays with its source, for the `ticks`-th tick in a row."""

    vehicle: int
    ticks: int


class Birth(NamedTuple):
    """A vehicle that enters the world in a zone."""

    vehicle: int
    zone: int
    state: bytes


class ZoneLedger(NamedTuple):
    """The tally of a zone at the commit of a tick, and the digest of its rows."""

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
    """An episode begins without vehicles, and a tick in progress is void. First line of a log."""

    run: bytes


@dataclass(slots=True, unsafe_hash=True)
class Begin(Record):
    """The decisions for `tick`. `inputs` is the digest of the actions.

    `teleports` are the vehicles of `switches` whose new zone is not a neighbour of the old zone.
    """

    switches: tuple[Switch, ...] = ()
    deferred: tuple[Deferral, ...] = ()
    births: tuple[Birth, ...] = ()
    inputs: bytes = b""
    teleports: tuple[int, ...] = ()


@dataclass(slots=True, unsafe_hash=True)
class Commit(Record):
    """`tick` is committed."""

    removed: tuple[Removed, ...] = ()
    zones: tuple[ZoneLedger, ...] = ()
    world: int = 0


@dataclass(slots=True, unsafe_hash=True)
class Fence(Record):
    """Messages of the process with this incarnation are dropped from now on."""

    zone: int
    incarnation: int


@dataclass(slots=True, unsafe_hash=True)
class Host(Record):
    """A new host, with this incarnation, runs the zone in the process number `worker`."""

    zone: int
    incarnation: int
    worker: int


@dataclass(slots=True, unsafe_hash=True)
class Output:
    """Records to store, then messages to send."""

    records: tuple[Record, ...] = ()
    messages: tuple[Message, ...] = ()


Item: TypeAlias = Message | Record
