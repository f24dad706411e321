"""`DirectCoordinator`: the referee of a world whose zones all live in its own process.

There nothing is lost, nobody is late, and nobody dies alone. What `Coordinator` and the hosts of
its zones tell each other is known to all of them at once, so no message is made: a vehicle over a
border is offered, acknowledged and handed over in one call, the new owner takes the old one's row
as it is, and a lease is the call that advances a shard. What is decided and written down is the
same, record by record, as over messages of which none is lost.

A tick in which nobody enters, leaves, or changes its zone is not even written down, unless there is
a journal.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Protocol, runtime_checkable

from cavmarl.errors import LedgerError, ProtocolError
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.ledger import Tally, world_digest
from cavmarl.ownership.messages import Begin, Birth, Commit, Record, Removed, Switch, ZoneLedger
from cavmarl.ownership.planning import Plan
from cavmarl.runtime.journal import AnyJournal
from cavmarl.runtime.referee import Entry, Near, Referee, Watcher

__all__ = ["DirectCoordinator", "DirectWatcher"]


@runtime_checkable
class DirectWatcher(Watcher, Protocol):
    """Is told what goes on without messages, too."""

    def approached(self, tick: int, states: Collection[tuple[int, int, int]]) -> None:
        """(vehicle, target, epoch) of all whom their targets know of, as of a tick."""
        ...

    def confirmed(self, vehicles: Iterable[int]) -> None:
        """Vehicles that their new owners have advanced."""
        ...


class DirectCoordinator(Referee):
    """Says who owns what, without messages.

    Args:
        directory: who owns what.
        journal: takes the records; None: nobody keeps them.
        counts: how many vehicles each zone owns now, by its rows.
    """

    def __init__(
        self, directory: Directory, journal: AnyJournal | None, counts: Callable[[], list[int]]
    ) -> None:
        super().__init__(directory, journal)
        self._counts = counts
        self._direct_watchers: tuple[DirectWatcher, ...] = ()
        self._is_open = False
        self._pairs: dict[tuple[int, int, int], int] = {}  # vehicle, target, epoch → owner
        self._told = 0  # how many of them the watchers know of

    @property
    def is_open(self) -> bool:
        """Whether a tick has been begun and is not committed."""
        return self._is_open

    def watch(self, watcher: Watcher) -> None:
        """Tell one more of all that happens from now on."""
        super().watch(watcher)
        if isinstance(watcher, DirectWatcher):
            self._direct_watchers = (*self._direct_watchers, watcher)

    def reset(self) -> None:
        """Begin an episode without vehicles."""
        self.resume()
        self._is_open, self._pairs, self._told = False, {}, 0
        directory = self.directory
        self._log(directory.reset().records)
        for zone, (_, incarnation) in directory.table.hosts.items():
            if incarnation == 0:
                self._log(directory.host(zone, worker=0).records)

    def begin(
        self, near: Sequence[Near], state: Callable[[Near], bytes], inputs: bytes = b""
    ) -> list[Entry]:
        """Hand over whoever is in another zone than its owner's, as `Referee.begin` says."""
        self._is_open, self._removed = True, []
        births, self._births = self._births, []
        switches = self._approach(near) if near or self._told else []
        if not switches and not births and self.journal is None:
            return []
        self._plan(tuple(sorted(switches)), births, inputs)
        return [Entry(switch, None) for switch in switches]

    def end(self, rows: Callable[[int], int], stored: Callable[[int], int] | None = None) -> None:
        """Commit, if the zones own what they should, as `Referee.end` says."""
        table = self.directory.table
        removed = tuple(sorted((*self._gone, *self._removed)))
        if table.plan is None and removed:
            self._plan((), (), b"")
        plan = table.plan
        expected = table.tallies if plan is None else _after(plan, removed, self.directory)
        owned = [tally.vehicles for tally in expected.values()]
        for birth in self._births:  # they are in the rows, and will be on record in the next tick
            owned[birth.zone] += 1
        counts = self._counts()
        if counts != owned:
            raise LedgerError(f"tick {table.tick + 1}: zones own {counts} vehicles, not {owned}")
        self._is_open, self._gone = False, []
        if plan is None:
            table.pass_quietly()
            return
        zones = tuple(
            ZoneLedger(zone, table.hosts[zone][1], tally, rows(zone))
            for zone, tally in expected.items()
        )
        begin, world = plan.record, world_digest(ledger.rows for ledger in zones)
        if plan.switches:
            for watcher in self._direct_watchers:
                watcher.confirmed(plan.switches)
        self._apply(Commit(begin.episode, begin.tick, removed, zones, world))

    def in_flight(self) -> list[tuple[int, int, int, str]]:
        """(vehicle, owner, zone that knows that it comes, `prepared`), between two ticks."""
        return sorted(
            (vehicle, owner, target, "prepared")
            for (vehicle, target, _), owner in self._pairs.items()
        )

    def dropped(self) -> Counter[tuple[str, str]]:
        """Nothing: there are no messages."""
        return Counter()

    def _approach(self, near: Sequence[Near]) -> list[Switch]:
        """Let targets know who comes; who is there already changes its owner."""
        owners = self.directory.table.owners
        pairs: dict[tuple[int, int, int], int] = {}
        switches = []
        for vehicle, source, _, target, crossed, _ in near:
            if vehicle not in owners:  # it has entered since the last BEGIN
                continue
            owner, epoch = owners[vehicle]
            if owner != source:
                raise ProtocolError(f"vehicle {vehicle} is in the rows of {source}, not of {owner}")
            pairs[vehicle, target, epoch] = source
            if crossed:
                switches.append(Switch(vehicle, source, target, epoch + 1, False))
        for watcher in self._direct_watchers:
            watcher.approached(self.tick, pairs)
        self._told = len(pairs)
        for switch in switches:
            del pairs[switch.vehicle, switch.target, switch.epoch - 1]
        self._pairs = pairs
        return switches

    def _plan(self, switches: tuple[Switch, ...], births: Sequence[Birth], inputs: bytes) -> None:
        table = self.directory.table
        new = tuple(sorted(births))
        if new:
            self.directory.check_births(new)
        self._apply(Begin(table.episode, table.tick + 1, switches, (), new, inputs))

    def _apply(self, record: Record) -> None:
        self.directory.table.apply(record)
        self._log((record,))


def _after(plan: Plan, removed: Iterable[Removed], directory: Directory) -> dict[int, Tally]:
    """Zone → what it owns when a plan is carried out and vehicles have been removed.

    Raises:
        LedgerError: nobody owns one of these.
    """
    expected, owners = dict(plan.expected), directory.table.owners
    for vehicle, _ in removed:
        zone, epoch = plan.owner(vehicle, owners)
        if zone < 0:
            raise LedgerError(f"vehicle {vehicle} is removed, which nobody owns")
        expected[zone] = expected[zone].minus(directory.run, vehicle, epoch)
    return expected
