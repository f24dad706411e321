"""Entries of a trace: the coordinator's records and all delivered messages, in order.

The program that runs the parties adds each record when it is logged, and each message when it is
delivered, before the receiver may drop it. `trace_check` checks a trace without the code of the
protocol; `describe` formats an entry for people.
"""

from __future__ import annotations

from typing import NamedTuple

from cavmarl.ownership.messages import (
    COORDINATOR,
    Abort,
    Ack,
    Begin,
    Commit,
    Done,
    Fence,
    Host,
    Item,
    Message,
    Nack,
    Need,
    Prepare,
    Record,
    Reset,
    Step,
)

LOG = -2
"""The destination of records."""


class TraceEntry(NamedTuple):
    """A record (destination LOG), or a message and its destination."""

    destination: int
    item: Item


def describe(entry: TraceEntry) -> str:
    item = entry.item
    name = type(item).__name__.upper()
    if isinstance(item, Record):
        return f"log    {name} {item.tick}{_record(item)}"
    sender = getattr(item, "source", getattr(item, "zone", COORDINATOR))
    if isinstance(item, Ack | Nack):
        sender = item.zone
    if isinstance(item, Step):
        sender = COORDINATOR
    return f"{_name(sender)} → {_name(entry.destination)}  {name} {item.tick}{_message(item)}"


def _name(place: int) -> str:
    return "C" if place == COORDINATOR else str(place)


def _record(record: Record) -> str:
    match record:
        case Reset():
            return f" episode {record.episode}"
        case Begin():
            parts = [f"v{b.vehicle} born in {b.zone}" for b in record.births]
            parts += [
                f"v{s.vehicle} {s.source}→{s.target} epoch {s.epoch}{' forced' * s.forced}"
                for s in record.switches
            ]
            parts += [f"v{d.vehicle} deferred {d.ticks}" for d in record.deferred]
        case Commit():
            parts = [f"v{entry.vehicle} removed" for entry in record.removed]
            parts += [" ".join(f"{entry.zone}:{entry.owned.vehicles}" for entry in record.zones)]
        case Fence() | Host():
            return f" zone {record.zone} incarnation {record.incarnation}"
        case _:
            return ""
    return "".join(f"  {part}" for part in parts)


def _message(message: Message) -> str:
    match message:
        case Step():
            parts = [f"spawn v{entry.vehicle}" for entry in message.spawn]
            parts += [f"out v{entry.vehicle}" for entry in message.leave]
            parts += [
                f"in v{entry.vehicle} epoch {entry.epoch}{' with its state' * entry.forced}"
                for entry in message.enter
            ]
        case Done():
            parts = [
                f"confirms v{entry.vehicle} epoch {entry.epoch}" for entry in message.confirmed
            ]
            parts += [f"removes v{entry.vehicle}" for entry in message.removed]
        case Prepare() | Abort() | Ack():
            parts = [f"v{entry.vehicle} epoch {entry.epoch}" for entry in message.entries]
        case Nack():
            parts = [f"v{entry.vehicle} {entry.reason.name.lower()}" for entry in message.entries]
        case Need():
            parts = [f"v{vehicle}" for vehicle in message.vehicles]
        case _:
            return ""
    return "".join(f"  {part}" for part in parts)
