"""A row for every transfer: when it was prepared, how long it waited, how it ended.

A `TransferLog` is told what a `Trace` is told, and keeps what is under way and the newest rows.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from cavmarl.ownership.messages import (
    COORDINATOR,
    Abort,
    Ack,
    Begin,
    Commit,
    Done,
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


class Surroundings(Protocol):
    """What the core does not know of itself."""

    def depth_m(self, vehicle: int, target: int) -> float | None:
        """How far outside of its owner's zone a vehicle near another one is; None: unknown."""
        ...

    def release_depth_m(self, vehicle: int, source: int, target: int) -> float | None:
        """How far outside of its old zone a vehicle is that has changed; None: it has left."""
        ...

    def now_ms(self) -> float: ...


@dataclass(slots=True)
class _Approach:
    first: int
    last: int
    offers: int
    state_bytes: int
    depth_m: float | None = None
    began_ms: float | None = None


@dataclass(slots=True)
class _Switching:
    depth_m: float | None
    began_ms: float | None
    ended_ms: float | None = None


_NEVER = _Approach(-1, -1, 0, 0)
UNKNOWN = _Switching(None, None)


class TransferLog:
    """Follows records and deliveries.

    Attributes:
        ask: called before each reading, to bring late records up to date.
    """

    def __init__(
        self,
        lifetime: int,  # ticks after which a state that is not refreshed is forgotten
        surroundings: Surroundings | None = None,  # tells depths and times; None: they are left out
    ) -> None:
        self.episode = -1  # of the newest record
        self.ask: Callable[[], None] = lambda: None
        self._rows: deque[Transfer] = deque(maxlen=KEPT_ROWS)
        self._later: deque[tuple[int, Callable[[], Iterable[Transfer]]]] = deque()
        self._num_later = 0
        self._counts: Counter[str] = Counter()
        self._lifetime = lifetime
        self._surroundings = surroundings
        self._approaches: dict[tuple[int, int, int], _Approach] = {}  # vehicle, target, epoch
        self._waited: dict[int, int] = {}
        self._begun: Begin | None = None
        self._switching: dict[int, _Switching] = {}

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
                        new = _Approach(message.tick, message.tick, 1, len(state))
                        if self._surroundings is not None:
                            new.depth_m = self._surroundings.depth_m(vehicle, message.target)
                            new.began_ms = self._surroundings.now_ms()
                        self._approaches[key] = new
                    else:
                        known.last = max(known.last, message.tick)
                        known.offers += 1
                        known.state_bytes = len(state)
            case Abort():
                for vehicle, epoch in message.entries:
                    if self._approaches.pop((vehicle, message.target, epoch), None) is not None:
                        self._counts["aborted"] += 1
            case Done() if message.confirmed:
                self._confirmed(message)
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
        self._switching = {}
        around = self._surroundings
        if around is not None:
            for switch in record.switches:
                depth_m = around.depth_m(switch.vehicle, switch.target)
                self._switching[switch.vehicle] = _Switching(depth_m, around.now_ms())

    def _confirmed(self, message: Done) -> None:
        if self._surroundings is None:
            return
        for vehicle, _ in message.confirmed:
            switching = self._switching.get(vehicle)
            if switching is not None:
                switching.ended_ms = self._surroundings.now_ms()

    def _commit(self, record: Commit) -> None:
        begun, self._begun = self._begun, None
        if begun is None:
            return
        gone = {entry.vehicle for entry in record.removed}
        for switch in begun.switches:
            vehicle = switch.vehicle
            switching = self._switching.get(vehicle, UNKNOWN)
            self._note(record.episode, record.tick, switch, switching, vehicle in gone)
        self._waited = dict(begun.deferred)
        oldest = record.tick - self._lifetime
        for key in [key for key, known in self._approaches.items() if known.last < oldest]:
            del self._approaches[key]
            self._counts["expired"] += 1

    def _note(
        self, episode: int, tick: int, switch: Switch, switching: _Switching, removed: bool
    ) -> None:
        vehicle, source, target, epoch, forced = switch
        found = self._approaches.pop((vehicle, target, epoch - 1), _NEVER)
        began_ms = switching.began_ms if found.began_ms is None else found.began_ms
        ended_ms, around = switching.ended_ms, self._surroundings
        release_m = None if around is None else around.release_depth_m(vehicle, source, target)
        row = Transfer(
            episode, tick, vehicle, source, target, epoch, forced, removed, found.first,
            self._waited.get(vehicle, 0), found.offers, found.state_bytes, found.depth_m,
            switching.depth_m, release_m,
            None if began_ms is None or ended_ms is None else ended_ms - began_ms,
        )  # fmt: skip
        self._add(row)
