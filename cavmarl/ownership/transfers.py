"""A row for every transfer: when it was prepared, how long it waited, how it ended.

A `TransferLog` is told what a `Trace` is told, and keeps what is under way and the newest rows.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
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
    Switch,
)

KEPT_ROWS = 10_000


class Transfer(NamedTuple):
    """A change of owner."""

    episode: int  # in which it was
    tick: int  # the tick that the new owner computed first
    vehicle: int  # that changed
    source: int  # from where
    target: int  # to where
    epoch: int  # the new one
    forced: bool  # whether the state rode along, since the target was not ready in time
    removed: bool  # whether the vehicle left the world in that tick
    approached: int  # tick of the first state that arrived at the target, or -1
    waited: int  # ticks for which the source went on after the crossing
    offers: int  # states that arrived at the target, repeats included
    # size of the last of them; 0 where no bytes were sent, since both zones live in one process
    state_bytes: int
    # how far it was outside of its owner's zone when the first of them arrived, less than 0 inside;
    # None: unknown
    prepare_depth_m: float | None = None
    switch_depth_m: float | None = None  # the same when its switch was decided
    # how far outside of its old zone when that was committed, and the old owner's copy went; None:
    # unknown, or it has left the world
    release_depth_m: float | None = None
    # from that first state, or else from BEGIN, until the target has confirmed; None: without a
    # clock
    ms: float | None = None

    @property
    def ticks(self) -> int:
        """From the first state that arrived at the target, or else from BEGIN, until DONE."""
        return self.tick - self.approached if self.approached >= 0 else 1 + self.waited


@dataclass(slots=True)
class _Approach:
    first: int
    last: int
    offers: int
    state_bytes: int


_NEVER = _Approach(-1, -1, 0, 0)


class TransferLog:
    """Follows records and deliveries.

    Attributes:
        ask: called before each reading, to bring late records up to date.
    """

    def __init__(
        self,
        lifetime: int,  # ticks after which a state that is not refreshed is forgotten
    ) -> None:
        self.episode = -1  # of the newest record
        self.ask: Callable[[], None] = lambda: None
        self._rows: deque[Transfer] = deque(maxlen=KEPT_ROWS)
        self._later: deque[tuple[int, Callable[[], Iterable[Transfer]]]] = deque()
        self._num_later = 0
        self._counts: Counter[str] = Counter()
        self._lifetime = lifetime
        self._approaches: dict[tuple[int, int, int], _Approach] = {}  # vehicle, target, epoch
        self._waited: dict[int, int] = {}
        self._begun: Begin | None = None

    @property
    def rows(self) -> deque[Transfer]:
        """The newest KEPT_ROWS transfers that have been committed; `take` takes them away."""
        self.ask()
        self._make_rows()
        return self._rows

    @property
    def counts(self) -> Counter[str]:
        """`aborted`, `acknowledged`, `deferred`, `expired`, `forced`, `removed`, `switched`."""
        self.ask()
        return self._counts

    def take(self) -> list[Transfer]:
        """The rows, which are not kept any longer."""
        rows = list(self.rows)
        self._rows.clear()
        return rows

    def logged(self, records: Iterable[Record]) -> None:
        for record in records:
            match record:  # the frequent ones first
                case Begin():
                    self._begin(record)
                case Commit():
                    self._commit(record)
                case Reset():
                    self.episode = record.episode
                    self._approaches, self._waited, self._begun = {}, {}, None

    def delivered(self, destination: int, message: Message) -> None:
        match message:
            case Prepare():
                for vehicle, epoch, _, state in message.entries:
                    key = (vehicle, message.target, epoch)
                    known = self._approaches.get(key)
                    if known is None:
                        self._approaches[key] = _Approach(message.tick, message.tick, 1, len(state))
                    else:
                        known.last = max(known.last, message.tick)
                        known.offers += 1
                        known.state_bytes = len(state)
            case Abort():
                for vehicle, epoch in message.entries:
                    if self._approaches.pop((vehicle, message.target, epoch), None) is not None:
                        self._counts["aborted"] += 1
            case Ack() if destination == COORDINATOR:
                self._counts["acknowledged"] += len(message.entries)
            case Nack() if destination == COORDINATOR:
                self._counts["refused"] += len(message.entries)

    def add_later(self, number: int, removed: int, make: Callable[[], Iterable[Transfer]]) -> None:
        """Note changes of owner that no message tells of; rows are made when they are read."""
        self._counts["switched"] += number
        if removed:
            self._counts["removed"] += removed
        self._later.append((number, make))
        self._num_later += number
        while self._num_later - self._later[0][0] >= KEPT_ROWS:
            self._num_later -= self._later.popleft()[0]

    def _make_rows(self) -> None:
        for _, make in self._later:
            self._rows.extend(make())
        self._later.clear()
        self._num_later = 0

    def _add(self, row: Transfer) -> None:
        self._make_rows()
        self._counts["forced" if row.forced else "switched"] += 1
        if row.removed:
            self._counts["removed"] += 1
        self._rows.append(row)

    def count(self, **numbers: int) -> None:
        """Note so many of `counts` that no message tells of."""
        self._counts.update({name: number for name, number in numbers.items() if number})

    def _begin(self, record: Begin) -> None:
        self._begun = record
        self._counts["deferred"] += len(record.deferred)

    def _commit(self, record: Commit) -> None:
        begun, self._begun = self._begun, None
        if begun is None:
            return
        gone = {entry.vehicle for entry in record.removed}
        for switch in begun.switches:
            self._note(record.episode, record.tick, switch, switch.vehicle in gone)
        self._waited = dict(begun.deferred)
        oldest = record.tick - self._lifetime
        for key in [key for key, known in self._approaches.items() if known.last < oldest]:
            del self._approaches[key]
            self._counts["expired"] += 1

    def _note(self, episode: int, tick: int, switch: Switch, removed: bool) -> None:
        vehicle, source, target, epoch, forced = switch
        found = self._approaches.pop((vehicle, target, epoch - 1), _NEVER)
        row = Transfer(
            episode, tick, vehicle, source, target, epoch, forced, removed, found.first,
            self._waited.get(vehicle, 0), found.offers, found.state_bytes,
        )  # fmt: skip
        self._add(row)
