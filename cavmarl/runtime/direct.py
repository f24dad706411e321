"""`DirectCoordinator`: the referee of a world whose zones all live in its own process.

There nothing is lost, nobody is late, and nobody dies alone. What `Coordinator` and the hosts of
its zones tell each other is known to all of them at once, so no message is made: a vehicle over a
border is offered, acknowledged and handed over in one call, the new owner takes the old one's row
as it is, and a lease is the call that advances a shard. What is decided and written down is the
same, record by record, as over messages of which none is lost.

Records are made only where somebody reads them: all of them for a journal, and for watchers those
of ticks in which a vehicle has entered, left, or changed its owner.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from cavmarl.errors import LedgerError, ProtocolError
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.ledger import world_digest
from cavmarl.ownership.messages import (
    Begin,
    Birth,
    Commit,
    Removed,
    Switch,
    ZoneLedger,
)
from cavmarl.ownership.transfers import TransferLog
from cavmarl.runtime.journal import AnyJournal
from cavmarl.runtime.referee import Entry, Near, Referee

__all__ = ["DirectCoordinator"]


class DirectCoordinator(Referee):
    """Says who owns what, without messages.

    Args:
        directory: who owns what.
        journal: takes the records; None: nobody keeps them.
        counts: how many vehicles each zone owns now, by its rows.
        transfers: told of all that goes on.
    """

    def __init__(
        self,
        directory: Directory,
        journal: AnyJournal | None,
        counts: Callable[[], list[int]],
        transfers: TransferLog,
    ) -> None:
        super().__init__(directory, journal)
        self._counts = counts
        self._transfers = transfers
        self._is_open = False
        self._pairs: dict[tuple[int, int, int], float] = {}  # vehicle, target, epoch → depth, m
        self._has_told = False  # of somebody near, whose approach may be over
        self._switches: list[Switch] = []
        self._new: tuple[Birth, ...] = ()

    @property
    def is_open(self) -> bool:
        """Whether a tick has been begun and is not committed."""
        return self._is_open

    def reset(self) -> None:
        """Begin an episode without vehicles."""
        self.resume()
        self._is_open, self._pairs, self._has_told = False, {}, False
        directory = self.directory
        records = directory.reset().records
        self._transfers.logged(records)
        self._record(*records)
        for zone, (_, incarnation) in directory.table.hosts.items():
            if incarnation == 0:
                self._record(*directory.host(zone, worker=0).records)

    def begin(
        self, near: Sequence[Near], state: Callable[[Near], bytes], inputs: bytes = b""
    ) -> list[Entry]:
        """Hand over whoever is in another zone than its owner's, as `Referee.begin` says."""
        self._is_open, self._removed = True, []
        self._switches = self._approach(near) if near or self._has_told else []
        self._new = ()
        if self._births:
            self._new, self._births = tuple(sorted(self._births)), []
            self.directory.check_births(self._new)
        if self.journal is not None:
            self._record(self._begun(inputs))
        return [Entry(switch, None) for switch in self._switches]

    def end(self, rows: Callable[[int], int], stored: Callable[[int], int] | None = None) -> None:
        """Commit, if the zones own what they should, as `Referee.end` says."""
        table = self.directory.table
        self._is_open = False
        if self._switches or self._new or self._gone or self._removed:
            self._settle(rows)
            return
        table.settle()
        if self.journal is not None:
            self._record(self._committed((), rows))

    def _settle(self, rows: Callable[[int], int]) -> None:
        """Commit a tick in which somebody has entered, left, or changed its owner."""
        table, switches = self.directory.table, self._switches
        removed = tuple(sorted((*self._gone, *self._removed)))
        self._gone = []
        is_watched = self.journal is None and self._watchers
        begun = (self._begun(),) if is_watched else ()
        table.settle(switches, self._new, removed)
        self._check()
        if switches:
            self.switched += len(switches)
            self._transfers.settled(table.episode, table.tick, switches, removed)
        if self.journal is not None or is_watched:
            self._record(*begun, self._committed(removed, rows))

    def _begun(self, inputs: bytes = b"") -> Begin:
        table = self.directory.table
        return Begin(table.episode, table.tick + 1, tuple(self._switches), (), self._new, inputs)

    def _committed(self, removed: tuple[Removed, ...], rows: Callable[[int], int]) -> Commit:
        table = self.directory.table
        zones = tuple(
            ZoneLedger(zone, table.hosts[zone][1], tally, rows(zone))
            for zone, tally in table.tallies.items()
        )
        world = world_digest(ledger.rows for ledger in zones)
        return Commit(table.episode, table.tick, removed, zones, world)

    def in_flight(self) -> list[tuple[int, int, int, str]]:
        """(vehicle, owner, zone that knows that it comes, `prepared`), between two ticks."""
        owners = self.directory.table.owners
        return sorted(
            (vehicle, owners[vehicle][0], target, "prepared")
            for vehicle, target, _ in self._pairs
            if vehicle in owners
        )

    def dropped(self) -> Counter[tuple[str, str]]:
        """Nothing: there are no messages."""
        return Counter()

    def _approach(self, near: Sequence[Near]) -> list[Switch]:
        """Let targets know who comes; who is there already changes its owner."""
        owners = self.directory.table.owners
        pairs: dict[tuple[int, int, int], float] = {}
        switches = []
        for vehicle, source, _, target, crossed, depth_m in near:
            if vehicle not in owners:  # it has entered since the last BEGIN
                continue
            owner, epoch = owners[vehicle]
            if owner != source:
                raise ProtocolError(f"vehicle {vehicle} is in the rows of {source}, not of {owner}")
            pairs[vehicle, target, epoch] = depth_m
            if crossed:
                switches.append(Switch(vehicle, source, target, epoch + 1, False))
        self._transfers.approached(self.tick, pairs)
        self._has_told = bool(pairs)
        self._pairs = pairs
        if switches:
            switches.sort()
            for switch in switches:
                del pairs[switch.vehicle, switch.target, switch.epoch - 1]
        return switches

    def _check(self) -> None:
        """Compare what zones should own with their rows.

        Raises:
            LedgerError: a zone has more or fewer.
        """
        owned = list(self.directory.table.counts.values())
        for birth in self._births:  # they are in the rows, and will be on record in the next tick
            owned[birth.zone] += 1
        counts = self._counts()
        if counts != owned:
            raise LedgerError(f"at tick {self.tick} zones own {counts} vehicles, not {owned}")
