"""`ZonedShards`: the shards of W worlds, and the rows that are exchanged between them.

In each tick, every zone receives ghosts of the vehicles that it may see (decision 012). A
coordinator decides changes of owner between two ticks. The old shard keeps the vehicle as a ghost.
The new shard already has a ghost of the vehicle, and continues from the state that it receives.
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
    """Numbers of vehicles in the zones of W worlds."""

    owned: NDArray[np.int64]  # (k, W) owned vehicles
    ghosts: NDArray[np.int64]  # (k, W) ghosts
    halo_m: float  # how far zones see beyond their borders

    def imbalance(self) -> NDArray[np.float64]:
        """Return the imbalance (W,) of owned vehicles: maximum / mean over zones."""
        return np.array([imbalance(owned) for owned in self.owned.T.tolist()])


class ZonedShards:
    """All shards of W worlds, with their owned vehicles and ghosts.

    Attributes:
        gathering: (touching_m, border_m), the arguments of the phase `gather`. A ghost farther than
            `touching_m` outside of a zone touches no vehicle of the zone. A vehicle is at a border
            if its distance to the border is at most `border_m`.
        neighbours: (k, k) whether vehicles can change their owner between two zones.
        row_count: sets the numbers of rows in an undivided world.
        changes: finds vehicles near borders and changes their owners.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # one per zone, in the order of zones
        zoned: ZoneState,  # the rows of all shards
        partition: ZonePartition,
        halo: Halo,  # halo of this partition
        sight: Visibility,  # computes the halos of other partitions
        touching_m: float,  # a ghost farther outside of a zone cannot touch a vehicle of the zone
        borders: Borders,
        codec: TransferCodec,  # encodes and decodes the states of vehicles
        row_check: RowCheck,  # checks rows from outside
        may_teleport: bool,  # whether vehicles may jump to any place between two ticks
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
        """Distribute the vehicles of the chosen worlds (W,) from the first shard to all shards."""
        if len(self._shards) == 1:
            return
        first = self._shards[0].worlds
        for w in np.flatnonzero(chosen).tolist():
            vehicles = first.rows[w, : first.num_owned[w]].copy()
            for shard in self._shards:
                worlds = shard.worlds
                worlds.num_owned[w] = take_own(
                    self.zones, shard.zone, vehicles, len(vehicles), worlds.rows[w]
                )
                worlds.num_contacts[w] = 0
                worlds.num_outer[w] = -1
            self._forget_offers(w)
            self._exchange(first.rows, w, w + 1)

    def cut(self, partition: ZonePartition) -> None:
        """Change the zones between two ticks. Vehicles keep their owners, and ghosts are renewed.

        A vehicle outside of its owner's new zone changes its owner later, as at any border.
        """
        self.divide(partition)
        self._zoned.num_outer[...] = -1
        book = self.book
        tick = book.tick.copy()
        for w in range(self.num_worlds):
            self._forget_offers(w)
        self._exchange(self._shards[0].worlds.rows, 0, self.num_worlds)
        book.tick[:] = tick  # the rows still belong to this tick

    def divide(self, partition: ZonePartition) -> None:
        """Set the zones. The caller must then set owners and ghosts."""
        zones, halo = partition.arrays, self._sight.halo(partition)
        self.zones, self._halo = zones, halo
        self.neighbours = partition.within(self._sight.outside_m)
        for shard in self._shards:
            shard.cut(zones, halo)

    def _forget_offers(self, w: int) -> None:
        """Forget vehicles near a border, so that they do not count as turned back."""
        for known in (self.book.num_near, self.book.num_coming, self.book.known):
            known[w] = 0

    def exchange(self) -> None:
        """Renew all ghosts from the owned `next_rows`.

        If shards renew them in `gather`, `note_gathered` must follow before the tick ends.
        """
        if self._gatherers is not None:
            self._gatherers.gather(*self.gathering)
            return
        worlds = self._shards[0].worlds
        self._exchange(worlds.next_rows, 0, len(worlds.ticks))

    def count_rows(self) -> None:
        """Replace `exchange` in an undivided world without a coordinator."""
        self.row_count()

    def let_gather(self, executor: Executor) -> bool:
        """Let the shards renew ghosts in the phase `gather`, if possible; return whether they do.

        A shard that gathers reads all other shards. So this requires that all zones see each other.
        """
        if len(self._halo.near) == self.count**2:
            self._gatherers = executor
        return self._gatherers is not None

    def note_gathered(self) -> None:
        """Record vehicles near a border, after all shards have gathered."""
        self._note_near_vehicles(self.book)

    def rehearse_gathering(self) -> None:
        """Call the kernel of `note_gathered` without keeping its results."""
        self._note_near_vehicles(make_book(*self._first_side.shape))

    def _note_near_vehicles(self, book: BorderRecords) -> None:
        self._note_gathered(self.zones, self.borders, self._zoned, self.next_side, book)

    def _exchange(self, rows: NDArray[np.void], first: int, last: int) -> None:
        """Renew the ghosts of some worlds; `rows` are the first shard's rows or next rows."""
        self._call_exchange(
            self.zones, self._halo, self._touching_m, self.borders, self._zoned,
            self._side(rows), first, last, self.book,
        )  # fmt: skip

    def _side(self, rows: NDArray[np.void]) -> int:
        return 0 if rows is self._first_side else 1

    def place(
        self,
        vehicles: Sequence[NDArray[np.void]],  # VEHICLE (n,) of each world
        contacts: NDArray[np.int64],  # (W,) as `contacts` counts them
    ) -> None:
        """Give every vehicle to the zone that contains it, independent of its former owner."""
        first = self._shards[0].worlds
        # The `step` entries of an unfinished tick may belong to other rows.
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
        home: int,  # the zone that stores the contacts
        keeps_epochs: bool = False,  # whether to keep the epochs in the rows; if not, they become 0
    ) -> None:
        """Restore the owned vehicles of every zone, and renew the ghosts."""
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
        """Return the number (W,) of vehicles that began to touch another since the reset."""
        return np.asarray(self._zoned.num_contacts.sum(axis=0), dtype=np.int64)

    def align(self) -> None:
        """Let all shards use the first buffer of rows after an abandoned tick."""
        for shard in self._shards:
            shard.align()

    def owned(self, w: int, zone: int) -> NDArray[np.void]:
        """Return a view of the committed rows VEHICLE (n,) that a zone owns."""
        worlds = self._shards[zone].worlds
        rows: NDArray[np.void] = worlds.rows[w, : worlds.num_owned[w]]
        return rows

    def ghosts(self, w: int, zone: int) -> NDArray[np.void]:
        """Return a read-only view of the committed ghosts VEHICLE (n,) of a zone."""
        worlds = self._shards[zone].worlds
        rows: NDArray[np.void] = worlds.rows[w, worlds.num_owned[w] : worlds.num_rows[w]]
        rows.flags.writeable = False
        return rows

    def ticks(self, w: int) -> list[int]:
        """Return the clock of each zone: ticks since the world's reset."""
        return [shard.worlds.ticks.item(w) for shard in self._shards]

    @property
    def zoned(self) -> ZoneState:
        return self._zoned

    @property
    def halo(self) -> Halo:
        return self._halo

    @property
    def side(self) -> int:
        """The buffer of `zoned.rows` with the committed rows."""
        return self._side(self._shards[0].worlds.rows)

    @property
    def next_side(self) -> int:
        return self._side(self._shards[0].worlds.next_rows)

    def owners(self, w: int) -> list[tuple[int, int]]:
        """Return (id, zone) of all vehicles of a world."""
        return [
            (vehicle, shard.zone)
            for shard in self._shards
            for vehicle in shard.worlds.rows["id"][w, : shard.worlds.num_owned[w]].tolist()
        ]

    def counts(self, w: int) -> list[int]:
        counts: list[int] = self._zoned.num_owned[:, w].tolist()
        return counts

    def running(self) -> NDArray[np.int64]:
        """Return the number (W,) of vehicles of each world."""
        self._count_running()
        return self._running.copy()

    def loads(self) -> ZoneLoads:
        owned = np.array([shard.worlds.num_owned for shard in self._shards])
        rows = np.array([shard.worlds.num_rows for shard in self._shards])
        return ZoneLoads(owned, rows - owned, self._halo.halo_m)

    def vehicles(self, world: int) -> NDArray[np.void]:
        """Return all vehicles of a world: a copy if there are several shards, else a view."""
        parts = [s.worlds.rows[world, : s.worlds.num_owned[world]] for s in self._shards]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    @contextmanager
    def all_next_rows(self) -> Iterator[Worlds]:
        """Yield the owned `next_rows` of all zones as one shard. Changes are written back."""
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
        """Return all zones as one shard, without `next_rows`; several shards are copied."""
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
