"""Rows about transfers: when they were prepared, how long they waited, how they ended.

A `TransferLog` receives the same records and messages as a `Trace`. It keeps current approaches and
the newest transfers.
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

    episode: int
    tick: int  # the first tick that the new owner computed
    vehicle: int
    source: int  # the old owner
    target: int  # the new owner
    epoch: int  # epoch of the new ownership
    forced: bool  # whether the state was attached, because the target was not ready in time
    removed: bool  # whether the vehicle left the world in tick `tick`
    approached: int  # tick of the first state that arrived at the target, or -1
    waited: int  # ticks for which the source kept the vehicle after the crossing
    offers: int  # number of states that arrived at the target, including repeats
    state_bytes: int  # size of the last state; 0 if both zones are in one process
    # distance outside of the owner's zone when the first state arrived; negative: inside; None:
    # unknown
    prepare_depth_m: float | None = None
    switch_depth_m: float | None = None  # same distance when the switch was decided
    # distance outside of the old zone when the switch was committed; None: unknown, or the vehicle
    # has left the world
    release_depth_m: float | None = None
    # ms from the first state (if none: from BEGIN) to the target's confirmation; None: no clock
    ms: float | None = None

    @property
    def ticks(self) -> int:
        """Ticks from the first state at the target (if none: from BEGIN) to DONE."""
        return self.tick - self.approached if self.approached >= 0 else 1 + self.waited


@dataclass(slots=True)
class _Approach:
    first: int
    last: int
    offers: int
    state_bytes: int
    began_s: float | None  # when the first state arrived; None: no clock


_NEVER = _Approach(-1, -1, 0, 0, None)


class TransferLog:
    """A log of transfers, made from records and delivered messages.

    Attributes:
        ask: called before each access, so that the coordinator can add outstanding entries.
    """

    def __init__(
        self,
        lifetime: int,  # ticks after which a state that is not refreshed is forgotten
        clock: Callable[[], float] | None = None,  # returns the time in s; None: no clock
    ) -> None:
        self._clock = clock
        self._begun_s: float | None = None  # when the record BEGIN arrived
        self.episode = -1  # episode of the newest record
        self.ask: Callable[[], None] = lambda: None
        self._rows: deque[Transfer] = deque(maxlen=KEPT_ROWS)
        self._later: deque[tuple[int, Callable[[], Iterable[Transfer]]]] = deque()
        self._num_later = 0
        self._counts: Counter[str] = Counter()
        self._lifetime = lifetime
        self._approaches: dict[tuple[int, int, int], _Approach] = {}  # by vehicle, target, epoch
        self._waited: dict[int, int] = {}
        self._begun: Begin | None = None

    @property
    def rows(self) -> deque[Transfer]:
        """The newest KEPT_ROWS committed transfers; `take` removes them."""
        self.ask()
        self._make_rows()
        return self._rows

    @property
    def counts(self) -> Counter[str]:
        """`aborted`, `acknowledged`, `deferred`, `expired`, `forced`, `removed`, `switched`."""
        self.ask()
        return self._counts

    def take(self) -> list[Transfer]:
        """Return and remove the rows."""
        rows = list(self.rows)
        self._rows.clear()
        return rows

    def logged(self, records: Iterable[Record]) -> None:
        for record in records:
            match record:  # frequent records first
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
                        tick, now_s = message.tick, self._now_s()
                        self._approaches[key] = _Approach(tick, tick, 1, len(state), now_s)
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

    def _now_s(self) -> float | None:
        return None if self._clock is None else self._clock()

    def add_later(self, number: int, removed: int, make: Callable[[], Iterable[Transfer]]) -> None:
        """Add changes of owner that needed no messages; `make` is called when rows are read."""
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
        """Increase `counts` by events without messages."""
        self._counts.update({name: number for name, number in numbers.items() if number})

    def _begin(self, record: Begin) -> None:
        self._begun, self._begun_s = record, self._now_s()
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
        now_s, began_s = self._now_s(), found.began_s or self._begun_s
        ms = None if now_s is None or began_s is None else 1e3 * (now_s - began_s)
        row = Transfer(
            episode, tick, vehicle, source, target, epoch, forced, removed, found.first,
            self._waited.get(vehicle, 0), found.offers, found.state_bytes, ms=ms,
        )  # fmt: skip
        self._add(row)
