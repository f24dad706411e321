"""A row for every transfer: when it was prepared, how long it waited, how it ended.

A `TransferLog` is told what a `Trace` is told, and keeps only what is under way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from cavmarl.ownership.messages import (
    COORDINATOR,
    Abort,
    Ack,
    Begin,
    Commit,
    Message,
    Nack,
    Prepare,
    Record,
    Reset,
)


class Transfer(NamedTuple):
    """A change of owner.

    Attributes:
        episode: in which it was.
        tick: the tick that the new owner computed first.
        vehicle: who changed.
        source: from where.
        target: to where.
        epoch: the new one.
        forced: whether the state rode along, since the target was not ready in time.
        removed: whether the vehicle left the world in that tick.
        approached: tick of the first state that arrived at the target, or -1.
        waited: ticks for which the source went on after the crossing.
        offers: states that arrived at the target, repeats included.
        state_bytes: size of the last of them.
    """

    episode: int
    tick: int
    vehicle: int
    source: int
    target: int
    epoch: int
    forced: bool
    removed: bool
    approached: int
    waited: int
    offers: int
    state_bytes: int


@dataclass(slots=True)
class _Approach:
    first: int
    last: int
    offers: int
    state_bytes: int


class TransferLog:
    """Follows records and deliveries.

    Attributes:
        rows: transfers that have been committed; the user may take them away.
        counts: `aborted`, `acknowledged`, `deferred`, `forced`, `refused`, `switched`.
    """

    def __init__(self, lifetime: int) -> None:
        self.rows: list[Transfer] = []
        self.counts: Counter[str] = Counter()
        self._lifetime = lifetime
        self._approaches: dict[tuple[int, int, int], _Approach] = {}  # vehicle, target, epoch
        self._waited: dict[int, int] = {}
        self._begun: Begin | None = None

    def logged(self, records: Iterable[Record]) -> None:
        """Note records, in the order of the log."""
        for record in records:
            match record:
                case Reset():
                    self._approaches, self._waited, self._begun = {}, {}, None
                case Begin():
                    self._begun = record
                    self.counts["deferred"] += len(record.deferred)
                case Commit():
                    self._commit(record)

    def delivered(self, destination: int, message: Message) -> None:
        """Note a message that arrived."""
        match message:
            case Prepare():
                for vehicle, epoch, _, state in message.entries:
                    key = (vehicle, message.target, epoch)
                    known = self._approaches.get(key)
                    if known is None:
                        new = _Approach(message.tick, message.tick, 1, len(state))
                        self._approaches[key] = new
                    else:
                        known.last = max(known.last, message.tick)
                        known.offers += 1
                        known.state_bytes = len(state)
            case Abort():
                for vehicle, epoch in message.entries:
                    if self._approaches.pop((vehicle, message.target, epoch), None) is not None:
                        self.counts["aborted"] += 1
            case Ack() if destination == COORDINATOR:
                self.counts["acknowledged"] += len(message.entries)
            case Nack() if destination == COORDINATOR:
                self.counts["refused"] += len(message.entries)

    def _commit(self, record: Commit) -> None:
        begun, self._begun = self._begun, None
        if begun is None:
            return
        gone = {entry.vehicle for entry in record.removed}
        for vehicle, source, target, epoch, forced in begun.switches:
            self.counts["forced" if forced else "switched"] += 1
            found = self._approaches.pop((vehicle, target, epoch - 1), _Approach(-1, -1, 0, 0))
            self.rows.append(
                Transfer(
                    record.episode, record.tick, vehicle, source, target, epoch, forced,
                    vehicle in gone, found.first, self._waited.get(vehicle, 0), found.offers,
                    found.state_bytes,
                )
            )  # fmt: skip
        self._waited = dict(begun.deferred)
        oldest = record.tick - self._lifetime
        for key in [key for key, known in self._approaches.items() if known.last < oldest]:
            del self._approaches[key]
