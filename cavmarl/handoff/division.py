"""`ZonedShards`: the shards of one set of worlds, and the rows that go between them.

Ghosts go each tick to every zone that may see them (decision 012). A vehicle changes its owner
between two ticks, when the coordinator says so: its old shard keeps it as a ghost, the new one has
had it as a ghost already, and goes on with the state that it was sent.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.compiled.bound_call import bind
from cavmarl.core.math.counters import totals
from cavmarl.core.records.arrays import Worlds, ZoneState
from cavmarl.handoff.owner_changes import OwnerChanges
from cavmarl.shards.executor import Executor
from cavmarl.shards.kernels.group_phases import count_rows
from cavmarl.shards.row_check import RowCheck
from cavmarl.shards.shard import Shard
from cavmarl.shards.vehicle_codec import TransferCodec
from cavmarl.zones.kernels.borders import Borders
from cavmarl.zones.kernels.ghost_exchange import exchange, note_gathered, take_own
from cavmarl.zones.kernels.ownership_changes import BorderRecords, make_book
from cavmarl.zones.kernels.zone_lookup import Halo, ZoneArrays
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.partition.zone_statistics import imbalance
from cavmarl.zones.visibility import Visibility


class ZoneLoads(NamedTuple):
    """What the zones of W worlds hold."""

    owned: NDArray[np.int64]  # (k, W) vehicles
    ghosts: NDArray[np.int64]  # (k, W) copies of other zones' vehicles
    halo_m: float  # how far zones see over their borders

    def imbalance(self) -> NDArray[np.float64]:
        """(W,) maximum over mean of the vehicles that zones own."""
        return np.array([imbalance(owned) for owned in self.owned.T.tolist()])


class ZonedShards:
    """Which zones own and see which vehicles.

    Attributes:
        gathering: what shards are called with that `gather` their ghosts: how far outside of a zone
            a ghost can be that touches a vehicle in it, and how far inside one is at a border, m.
        neighbours: (k, k) between which zones vehicles change their owner.
        row_count: the call that notes that an undivided world has no ghosts.
        changes: vehicles near borders, and how they change their owner.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # one a zone, in the order of zones
        zoned: ZoneState,  # their rows
        partition: ZonePartition,
        halo: Halo,  # what each zone sees over its borders
        sight: Visibility,  # what says so for other zones
        touching_m: float,  # no ghost further outside of a zone can touch one of its vehicles
        borders: Borders,  # when a vehicle is near one
        codec: TransferCodec,  # of vehicles' states
        row_check: RowCheck,  # of rows that come from outside
        may_teleport: bool,  # whether vehicles may be put anywhere between two ticks
    ) -> None:
        self.zones: ZoneArrays = partition.arrays
        self.neighbours = partition.within(sight.outside_m)
        self.may_teleport = may_teleport
        self.borders = borders
        self.codec = codec
        self.row_check = row_check
        self.book = make_book(*shards[0].worlds.rows.shape)  # vehicles near a border
        self._shards = tuple(shards)
        self._zoned = zoned
        self._first_side = shards[0].worlds.rows
        self._halo = halo
        self._sight = sight
        self._touching_m = touching_m
        self.gathering = (touching_m, borders.max_speed_mps * borders.ahead_s)
        self._gatherers: Executor | None = None
        self._call_exchange = specialized(exchange)
        self._note_gathered = specialized(note_gathered)
        self._running = np.zeros(self.num_worlds, dtype=np.int64)
        self._count_running = bind(totals, counts=zoned.num_owned, out=self._running)
        self.row_count = bind(count_rows, zoned=zoned)
        self.changes = OwnerChanges(self, self._shards)

    @property
    def count(self) -> int:
        return len(self._shards)

    @property
    def num_worlds(self) -> int:
        return len(self._shards[0].worlds.ticks)

    def distribute(self, chosen: NDArray[np.bool_]) -> None:
        """Give every shard its vehicles of the chosen worlds (W,), which are all in the first."""
        if len(self._shards) == 1:
            return
        first = self._shards[0].worlds
        for w in np.flatnonzero(chosen).tolist():
            everybody = first.rows[w, : first.num_owned[w]].copy()
            for shard in self._shards:
                worlds = shard.worlds
                worlds.num_owned[w] = take_own(
                    self.zones, shard.zone, everybody, len(everybody), worlds.rows[w]
                )
                worlds.num_contacts[w] = 0
                worlds.num_outer[w] = -1
            self._forget_offers(w)
            self._exchange(first.rows, w, w + 1)

    def cut(self, partition: ZonePartition) -> None:
        """Divide the plane otherwise, between two ticks: owners stay, ghosts are those of now.

        A vehicle in another zone than its owner's changes its owner as at any border.
        """
        self.divide(partition)
        self._zoned.num_outer[...] = -1
        book = self.book
        tick = book.tick.copy()
        for w in range(self.num_worlds):
            self._forget_offers(w)
        self._exchange(self._shards[0].worlds.rows, 0, self.num_worlds)
        book.tick[:] = tick  # of the rows that have been looked at once more

    def divide(self, partition: ZonePartition) -> None:
        """Say where zones are from now on; owners and ghosts are to be told anew."""
        zones, halo = partition.arrays, self._sight.halo(partition)
        self.zones, self._halo = zones, halo
        self.neighbours = partition.within(self._sight.outside_m)
        for shard in self._shards:
            shard.cut(zones, halo)

    def _forget_offers(self, w: int) -> None:
        """Vehicles near a border before are not to be counted again."""
        for known in (self.book.num_near, self.book.num_coming, self.book.known):
            known[w] = 0

    def exchange(self) -> None:
        """Renew all ghosts from the owned `next_rows`.

        Where shards `gather` them, `note_gathered` has to follow before the tick is over.
        """
        if self._gatherers is not None:
            self._gatherers.gather(*self.gathering)
            return
        worlds = self._shards[0].worlds
        self._exchange(worlds.next_rows, 0, len(worlds.ticks))

    def count_rows(self) -> None:
        """Instead of `exchange` where one zone is all and no coordinator asks about borders."""
        self.row_count()

    def let_gather(self, executor: Executor) -> bool:
        """From now on let shards `exchange` as a phase, if they run side by side; whether they do.

        A shard that gathers asks all others, so not where there are some that it never sees.
        """
        if len(self._halo.near) == self.count**2:
            self._gatherers = executor
        return self._gatherers is not None

    def note_gathered(self) -> None:
        """Note vehicles near a border, after all shards have gathered."""
        self._note_those_near(self.book)

    def rehearse_gathering(self) -> None:
        """Call what is called after shards have gathered, and forget what it has found."""
        self._note_those_near(make_book(*self._first_side.shape))

    def _note_those_near(self, book: BorderRecords) -> None:
        self._note_gathered(self.zones, self.borders, self._zoned, self.next_side, book)

    def _exchange(self, rows: NDArray[np.void], first: int, last: int) -> None:
        """Renew the ghosts of some worlds; `rows` are the first shard's rows or next ones."""
        self._call_exchange(
            self.zones, self._halo, self._touching_m, self.borders, self._zoned,
            self._side(rows), first, last, self.book,
        )  # fmt: skip

    def _side(self, rows: NDArray[np.void]) -> int:
        return 0 if rows is self._first_side else 1

    def place(
        self,
        vehicles: Sequence[NDArray[np.void]],  # VEHICLE (n,) of each world
        contacts: NDArray[np.int64],  # (W,) of each, as `contacts` counts them
    ) -> None:
        """Give every vehicle to the zone that it is in, whatever zone owned it before."""
        first = self._shards[0].worlds
        # A tick that was not ended may have left a step that is not what this says.
        self._zoned.step_at[...] = 0
        for w, rows in enumerate(vehicles):
            first.rows[w, : len(rows)] = rows
            first.num_owned[w] = first.num_rows[w] = len(rows)
            first.rows["owner"][w, : len(rows)] = 0
            if len(self._shards) > 1:
                first.rows["epoch"][w, : len(rows)] = 0
        self.distribute(np.ones(len(vehicles), dtype=np.bool_))
        first.num_contacts[:] = contacts

    def put_back(
        self,
        vehicles: Sequence[Sequence[NDArray[np.void]]],  # VEHICLE (n,) of each world and zone
        contacts: NDArray[np.int64],  # (W,) as `contacts` counts them
        home: int,  # the zone whose contacts these are from now on
        keeps_epochs: bool = False,  # vehicles have changed their owner as often as their rows say
    ) -> None:
        """Give every zone the vehicles that it owned; ghosts are to be renewed."""
        self._zoned.step_at[...] = 0
        self._zoned.num_outer[...] = -1
        self._zoned.num_contacts[...] = 0
        self._zoned.num_contacts[home] = contacts
        for w, zones in enumerate(vehicles):
            self._forget_offers(w)
            for shard, rows in zip(self._shards, zones, strict=True):
                worlds = shard.worlds
                worlds.rows[w, : len(rows)] = rows
                if not keeps_epochs:
                    worlds.rows["epoch"][w, : len(rows)] = 0
                worlds.rows["owner"][w, : len(rows)] = shard.zone
                worlds.num_owned[w] = worlds.num_rows[w] = len(rows)
        self._exchange(self._first_side, 0, self.num_worlds)

    def contacts(self) -> NDArray[np.int64]:
        """(W,) vehicles that began to touch another, since each world's reset."""
        return np.asarray(self._zoned.num_contacts.sum(axis=0), dtype=np.int64)

    def align(self) -> None:
        """Let all shards keep their rows on the same side, whatever a tick has come to."""
        for shard in self._shards:
            shard.align()

    def owned(self, w: int, zone: int) -> NDArray[np.void]:
        """VEHICLE (n,), the committed rows that a zone owns; a view."""
        worlds = self._shards[zone].worlds
        rows: NDArray[np.void] = worlds.rows[w, : worlds.num_owned[w]]
        return rows

    def ghosts(self, w: int, zone: int) -> NDArray[np.void]:
        """VEHICLE (n,), the committed copies that a zone has of others' vehicles.

        A view that cannot be written: only its owner changes a vehicle.
        """
        worlds = self._shards[zone].worlds
        rows: NDArray[np.void] = worlds.rows[w, worlds.num_owned[w] : worlds.num_rows[w]]
        rows.flags.writeable = False
        return rows

    def ticks(self, w: int) -> list[int]:
        """What the zones' clocks say: ticks since the world's reset."""
        return [shard.worlds.ticks.item(w) for shard in self._shards]

    @property
    def zoned(self) -> ZoneState:
        return self._zoned

    @property
    def halo(self) -> Halo:
        return self._halo

    @property
    def side(self) -> int:
        """On which side of `zoned.rows` the committed rows are."""
        return self._side(self._shards[0].worlds.rows)

    @property
    def next_side(self) -> int:
        return self._side(self._shards[0].worlds.next_rows)

    def owners(self, w: int) -> list[tuple[int, int]]:
        """(id, zone) of all vehicles of a world."""
        return [
            (vehicle, shard.zone)
            for shard in self._shards
            for vehicle in shard.worlds.rows["id"][w, : shard.worlds.num_owned[w]].tolist()
        ]

    def counts(self, w: int) -> list[int]:
        counts: list[int] = self._zoned.num_owned[:, w].tolist()
        return counts

    def running(self) -> NDArray[np.int64]:
        """(W,) vehicles of each world."""
        self._count_running()
        return self._running.copy()

    def loads(self) -> ZoneLoads:
        owned = np.array([shard.worlds.num_owned for shard in self._shards])
        rows = np.array([shard.worlds.num_rows for shard in self._shards])
        return ZoneLoads(owned, rows - owned, self._halo.halo_m)

    def vehicles(self, world: int) -> NDArray[np.void]:
        """All live vehicles of a world: of several shards a copy, of one a view."""
        parts = [s.worlds.rows[world, : s.worlds.num_owned[world]] for s in self._shards]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    @contextmanager
    def everybody_next(self) -> Iterator[Worlds]:
        """All owned `next_rows` as one shard would hold them; what is changed there goes back."""
        first = self._shards[0].worlds
        if len(self._shards) == 1:
            yield first
            return
        running = self.running()
        parts = [
            [s.worlds.next_rows[w, : s.worlds.num_owned[w]] for s in self._shards]
            for w in range(running.size)
        ]
        rows = np.empty((running.size, running.max(initial=0)), dtype=first.next_rows.dtype)
        for w, owned in enumerate(parts):
            np.concatenate(owned, out=rows[w, : running[w]])
        yield first._replace(rows=rows, next_rows=rows, num_owned=running, num_rows=running)
        for w, owned in enumerate(parts):
            place = 0
            for part in owned:
                part[:] = rows[w, place : place + len(part)]
                place += len(part)

    def whole(self) -> Worlds:
        """All worlds as one shard would hold them, without its `next_rows`: of several, a copy."""
        first = self._shards[0].worlds
        if len(self._shards) == 1:
            return first
        rows = np.zeros_like(first.rows)
        running = self.running()
        for w, num in enumerate(running.tolist()):
            rows[w, :num] = self.vehicles(w)
        return first._replace(
            rows=rows,
            next_rows=rows,
            num_owned=running,
            num_rows=running,
            num_contacts=self.contacts(),
        )
