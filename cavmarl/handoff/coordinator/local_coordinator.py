"""`LocalCoordinator`: the coordinator of a world whose zones are all in one process.

In one process no message is lost, no zone is late, and no process dies alone. So no messages are
needed: a vehicle that has crossed a border is offered, acknowledged and handed over in one call.
The new owner copies the old owner's row. The call that advances a shard replaces the lease. The
decisions and the records are the same as with messages if no message is lost.

The table of owners is updated from time to time, and on request. Records are made only if they are
read. A journal receives all records immediately. When the table is updated, watchers receive the
records of ticks in which a vehicle has entered, left or changed its owner. Callers that need
changes in the same tick set `foretell`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import repeat
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ProtocolError
from cavmarl.handoff.coordinator.coordinator import Coordinator
from cavmarl.handoff.coordinator.handoff_log import HandoffLog, OwnerChange, SavedBorders
from cavmarl.handoff.coordinator.invariant_monitor import Departed
from cavmarl.handoff.coordinator.journal import Journal, JournalPlace
from cavmarl.handoff.coordinator.saved_ownership import OwnershipNumbers, SavedOwnership
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.ledger import SeenIds, world_digest
from cavmarl.ownership.messages import Begin, Birth, Commit, Removed, Reset, Switch, ZoneLedger
from cavmarl.ownership.transfers import Transfer, TransferLog
from cavmarl.zones.kernels.ownership_changes import UNREAD_LIMIT


class _News(NamedTuple):
    """Vehicles that have entered and left in a tick."""

    births: tuple[Birth, ...] = ()
    removed: tuple[Removed, ...] = ()


_NO_NEWS = _News()


class LocalCoordinator(Coordinator):
    """A coordinator that decides ownership without messages.

    Attributes:
        foretell: called at once with changes of owner whose records follow later.
    """

    def __init__(
        self,
        directory: Directory,
        journal: Journal | None,  # stores the records; None: they are not stored
        book: HandoffLog,  # hands rows over
        counts: Callable[[], list[int]],  # returns the number of vehicles in each zone's rows
        transfers: TransferLog,  # receives all transfers
    ) -> None:
        super().__init__(directory, journal)
        self._book = book
        self._counts = counts
        self._transfers = transfers
        transfers.ask = self.catch_up
        self.foretell: Callable[[Iterable[OwnerChange]], None] | None = None
        self._is_open = False
        self._tick = 0
        self._vehicles = 0
        self._changed = 0  # number of changes in the current tick
        self._late = 0  # number of changes that are missing in the table
        self._new: tuple[Birth, ...] = ()
        self._news: dict[int, _News] = {}  # tick → entries that are missing in the table

    @property
    def directory(self) -> Directory:
        self.catch_up()
        return self._directory

    @property
    def tick(self) -> int:
        return self._tick

    @property
    def is_open(self) -> bool:
        return self._is_open

    def entered(self, vehicles: Iterable[tuple[int, int]]) -> None:
        known = len(self._births)
        super().entered(vehicles)
        self._vehicles += len(self._births) - known

    def left(self, vehicles: Iterable[tuple[int, int]]) -> None:
        gone = list(vehicles)
        super().left(gone)
        self._vehicles -= len(gone)

    def reset(self) -> None:
        directory = self.directory
        self.resume()
        self._is_open, self._changed, self._vehicles = False, 0, 0
        self._book.reset(self._tick)
        records = directory.reset().records
        self._transfers.logged(records)
        self._record(*records)
        for zone, (_, incarnation) in directory.table.hosts.items():
            if incarnation == 0:
                self._record(*directory.host(zone, worker=0).records)

    def save(self) -> SavedOwnership:
        table, borders = self.directory.table, self._book.save()
        born = {birth.vehicle: (birth.zone, 0) for birth in self._births}
        births = [(birth.vehicle, birth.zone) for birth in self._births]
        gone = [
            (vehicle, reason, *(born.get(vehicle) or table.owners[vehicle]))
            for vehicle, reason in self._gone
        ]
        journal = JournalPlace.nowhere() if self.journal is None else self.journal.place
        numbers = OwnershipNumbers(
            episode=table.episode,
            tick=self._tick,
            switched=self.switched,
            seen_below=table.seen.floor,
            is_stirred=0,
            repartition_steps_done=0,
            near_tick=borders.tick,
            acknowledged=borders.acknowledged,
            aborted=borders.aborted,
            crossed=borders.crossed,
            owned=borders.owned,
            known=borders.known,
            journal=journal,
        )
        return SavedOwnership(
            zones=np.zeros((0, 4)),
            counts=np.array(self._counts(), dtype=np.int64),
            numbers=numbers,
            seen=np.array(sorted(table.seen.above), dtype=np.int64),
            births=np.array(births, dtype=np.int64).reshape(-1, 2),
            gone=np.array(gone, dtype=np.int64).reshape(-1, 4),
            near=borders.near,
            coming=borders.coming,
            before=borders.before,
        )

    def go_on(self, saved: SavedOwnership, rows: Mapping[int, tuple[int, int]]) -> list[Departed]:
        numbers = saved.numbers
        if self.journal is not None:
            self.journal.go_to(numbers.journal)
        births = [Birth(vehicle, zone, b"") for vehicle, zone in saved.births.tolist()]
        gone = saved.gone.tolist()
        self.resume(births, (Removed(vehicle, reason) for vehicle, reason, _, _ in gone))
        owners = {**rows, **{vehicle: (zone, epoch) for vehicle, _, zone, epoch in gone}}
        for birth in births:
            del owners[birth.vehicle]
        table = self._directory.table
        run, seen = self._directory.run, SeenIds(numbers.seen_below, saved.seen.tolist())
        table.go_on(run, numbers.episode, numbers.tick, owners, seen)
        self._book.go_on(
            SavedBorders(
                tick=numbers.near_tick,
                acknowledged=numbers.acknowledged,
                aborted=numbers.aborted,
                crossed=numbers.crossed,
                owned=numbers.owned,
                known=numbers.known,
                near=saved.near,
                coming=saved.coming,
                before=saved.before,
            )
        )
        self._transfers.logged((Reset(numbers.episode, numbers.tick, run),))
        self.switched, self._tick, self._vehicles = numbers.switched, numbers.tick, len(rows)
        self._is_open, self._changed, self._late = False, 0, 0
        self._new, self._news = (), {}
        return [Departed(vehicle, zone, epoch) for vehicle, _, zone, epoch in gone]

    def begin(self, check_all: bool, inputs: bytes = b"") -> None:
        """Hand over vehicles outside of their owner's zone; see `Coordinator.begin`."""
        births = self._births
        try:
            changed = self._book.hand_over(check_all, self._vehicles, births)
        except ProtocolError:
            self._check(births, self._counts())
            raise
        self._is_open, self._changed = True, changed
        self.switched += changed
        self._new = ()
        if births:
            self._new, self._births = tuple(sorted(births)), []
        if self._removed:
            self._removed = []
        if self.journal is not None:
            switches = tuple(map(_switch, self._book.newest(changed)))
            self._record(self._begun(self._tick + 1, switches, self._new, inputs))

    def end(self, rows: Callable[[int], int]) -> None:
        """Check the numbers of vehicles and commit; see `Coordinator.end`."""
        changed, self._is_open = self._changed, False
        self._tick += 1
        if changed:
            self._changed = 0
            self._late += changed
            self._book.release(changed)
        removed: tuple[Removed, ...] = ()
        if self._gone or self._removed:
            removed = tuple(sorted((*self._gone, *self._removed)))
            self._gone = []
        has_news = bool(self._new or removed)
        if has_news:
            self._news[self._tick] = _News(self._new, removed)
        is_late = self._late >= UNREAD_LIMIT or len(self._news) >= UNREAD_LIMIT
        if self.journal is not None or is_late or (has_news and self._watchers):
            self.catch_up()
            self._check(self._births, self._counts())
            if self.journal is not None:
                self._record(self._committed(removed, rows))
        elif changed and self.foretell is not None:
            self.foretell(self._book.newest(changed))

    def catch_up(self) -> None:
        """Update the table and the log of transfers up to the current tick."""
        table = self._directory.table
        if table.tick == self._tick:
            return
        changes = self._book.take(but=self._changed)
        news, self._news, self._late = self._news, {}, 0
        if self.journal is None and self._watchers:
            ticks = changes["tick"]
            for tick in sorted({*ticks.tolist(), *news}):
                these = changes[ticks == tick]
                self._settle(tick, these, news.get(tick, _NO_NEWS), has_watchers=True)
        elif len(changes) or news:
            births = tuple(birth for tick in news.values() for birth in tick.births)
            removed = tuple(entry for tick in news.values() for entry in tick.removed)
            self._settle(self._tick, changes, _News(births, removed), has_watchers=False)
        table.settle(self._tick)
        if len(changes):
            left = {entry.vehicle: tick for tick, those in news.items() for entry in those.removed}
            removed_now = _removed_with(changes, left)
            episode = table.episode
            self._transfers.add_later(
                len(changes), sum(removed_now), lambda: _rows(changes, episode, removed_now)
            )
        self._book.forget_teleports(self._tick)
        acknowledged, aborted = self._book.take_counts()
        self._transfers.count(acknowledged=acknowledged, aborted=aborted)

    def _settle(
        self, tick: int, changes: NDArray[np.void], news: _News, has_watchers: bool
    ) -> None:
        """Apply changes up to a tick to the table, and make records if `has_watchers`."""
        table = self._directory.table
        columns = (changes[name].tolist() for name in ("vehicle", "source", "target", "epoch"))
        switches = tuple(map(Switch, *columns, repeat(False)))
        if has_watchers:
            self._record(self._begun(tick, switches, news.births))
        if news.births:
            self._directory.check_births(news.births)
        table.settle(tick, switches, news.births, news.removed)
        if has_watchers:
            self._record(self._committed(news.removed, _no_digest))

    def _begun(
        self,
        tick: int,
        switches: tuple[Switch, ...],
        births: tuple[Birth, ...],
        inputs: bytes = b"",
    ) -> Begin:
        teleports = self._book.teleports(switches, tick)
        episode = self._directory.table.episode
        return Begin(episode, tick, switches, (), births, inputs, teleports)

    def _committed(self, removed: tuple[Removed, ...], rows: Callable[[int], int]) -> Commit:
        table = self._directory.table
        zones = tuple(
            ZoneLedger(zone, table.hosts[zone][1], tally, rows(zone))
            for zone, tally in table.tallies.items()
        )
        world = world_digest(ledger.rows for ledger in zones)
        return Commit(table.episode, table.tick, removed, zones, world)

    def in_flight(self) -> list[tuple[int, int, int, str]]:
        """Return (vehicle, owner, zone that is prepared for it, "prepared"), between two ticks."""
        owners = self.directory.table.owners
        return sorted(
            (vehicle, owners[vehicle][0], target, "prepared")
            for vehicle, target in self._book.coming()
            if vehicle in owners
        )


def _no_digest(zone: int) -> int:
    """Return 0: without a journal, no digest is needed."""
    return 0


def _switch(change: OwnerChange) -> Switch:
    return Switch(change.vehicle, change.source, change.target, change.epoch, False)


def _removed_with(changes: NDArray[np.void], left: Mapping[int, int]) -> list[bool]:
    """Return whether each vehicle left the world in the tick of its change."""
    if not left:
        return [False] * len(changes)
    pairs = zip(changes["vehicle"].tolist(), changes["tick"].tolist(), strict=True)
    return [left.get(vehicle) == tick for vehicle, tick in pairs]


def _rows(changes: NDArray[np.void], episode: int, removed: list[bool]) -> list[Transfer]:
    found = (OwnerChange(*change) for change in changes.tolist())
    return [_row(change, episode, gone) for change, gone in zip(found, removed, strict=True)]


def _row(change: OwnerChange, episode: int, removed: bool) -> Transfer:
    release_m = change.release_depth_m
    return Transfer(
        episode=episode, tick=change.tick, vehicle=change.vehicle,
        source=change.source, target=change.target, epoch=change.epoch,
        forced=False, removed=removed, approached=change.approached, waited=0,
        offers=change.tick - change.approached, state_bytes=0,
        prepare_depth_m=change.prepare_depth_m, switch_depth_m=change.switch_depth_m,
        release_depth_m=None if release_m != release_m else release_m, ms=change.ms,
    )  # fmt: skip
