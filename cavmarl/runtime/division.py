"""`Division`: the shards of one set of worlds, and the rows that go between them.

Ghosts go each tick to every zone that may see them (decision 012). A vehicle that has left its zone
changes its owner between two ticks: its old shard keeps it as a ghost, the new one has had it as a
ghost already.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.errors import ZoneError
from cavmarl.kernels.arrays import Worlds
from cavmarl.kernels.exchange import adopt, find_movers, release, take_ghosts, take_own
from cavmarl.kernels.zones import Halo, ZoneArrays, make_publication, publish, zone_of
from cavmarl.shard.shard import Shard

__all__ = ["Division", "ZoneLoads"]


class ZoneLoads(NamedTuple):
    """What the zones of W worlds hold.

    Attributes:
        owned: (k, W) vehicles.
        ghosts: (k, W) copies of other zones' vehicles.
        migrations: vehicles that have changed their zone since the worlds were made.
        halo_m: how far zones see over their borders.
    """

    owned: NDArray[np.int64]
    ghosts: NDArray[np.int64]
    migrations: int
    halo_m: float


class Division:
    """Who owns what, and who sees what.

    Args:
        shards: one a zone, in the order of zones.
        zones: of the partition.
        halo: how far each zone sees over its borders.
        hysteresis_m: so far behind its border a vehicle changes its zone.
    """

    def __init__(
        self, shards: Sequence[Shard], zones: ZoneArrays, halo: Halo, hysteresis_m: float
    ) -> None:
        self._shards = tuple(shards)
        self._zones = zones
        self._halo = halo
        self._hysteresis_m = hysteresis_m
        self._migrations = 0
        capacity = shards[0].worlds.rows.shape[1]
        self._published = make_publication(capacity, len(shards))
        self._movers = np.zeros(capacity, dtype=np.int32)
        self._spare = np.zeros(1, dtype=shards[0].worlds.rows.dtype)

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
                    self._zones, shard.zone, everybody, len(everybody), worlds.rows[w]
                )
                worlds.num_contacts[w] = 0
            self._exchange(w, [shard.worlds.rows for shard in self._shards])

    def exchange(self) -> None:
        """Renew all ghosts from the owned `next_rows`."""
        if len(self._shards) > 1:
            rows = [shard.worlds.next_rows for shard in self._shards]
            for w in range(len(rows[0])):
                self._exchange(w, rows)

    def _exchange(self, w: int, rows: Sequence[NDArray[np.void]]) -> None:
        for shard in self._shards:
            shard.worlds.num_rows[w] = shard.worlds.num_owned[w]
        start = self._published.start
        for source, own in zip(self._shards, rows, strict=True):
            num = int(source.worlds.num_owned[w])
            if publish(self._zones, self._halo, own[w], num, source.zone, self._published) == 0:
                continue
            for target in np.flatnonzero(np.diff(start)).tolist():
                begin, end = int(start[target]), int(start[target + 1])
                held = self._shards[target].worlds.num_rows
                take_ghosts(own[w], self._published.rows, begin, end, rows[target][w], held[w])
                held[w] += end - begin

    def migrate(self) -> None:
        """Let the vehicles of `next_rows` that have left their zone change their owner."""
        if len(self._shards) == 1:
            return
        for source in self._shards:
            for w in range(source.worlds.num_owned.size):
                self._let_go(source, w)

    def _let_go(self, source: Shard, w: int) -> None:
        worlds = source.worlds
        rows, num = worlds.next_rows[w], int(worlds.num_owned[w])
        found = find_movers(self._zones, source.zone, self._hysteresis_m, rows, num, self._movers)
        self._migrations += int(found)
        # From the last row to the first: who is released is swapped with the last owned one.
        for i in self._movers[:found][::-1]:
            zone = zone_of(self._zones, rows[i]["x"], rows[i]["y"])
            target = self._shards[zone].worlds
            if not adopt(
                target.next_rows[w], int(target.num_owned[w]), int(target.num_rows[w]), rows[i]
            ):
                raise ZoneError(
                    f"vehicle {rows[i]['id']} entered zone {zone}, which has not seen it come: "
                    "the halo is too narrow"
                )
            target.num_owned[w] += 1
            release(rows, int(i), int(worlds.num_owned[w]), self._spare)
            worlds.num_owned[w] -= 1

    def running(self) -> NDArray[np.int64]:
        """(W,) vehicles of each world."""
        return _total([shard.worlds.num_owned for shard in self._shards])

    def loads(self) -> ZoneLoads:
        """What each zone holds, and how many vehicles have changed theirs."""
        owned = np.array([shard.worlds.num_owned for shard in self._shards])
        rows = np.array([shard.worlds.num_rows for shard in self._shards])
        return ZoneLoads(owned, rows - owned, self._migrations, self._halo.halo_m)

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
        contacts = _total([shard.worlds.num_contacts for shard in self._shards])
        return first._replace(
            rows=rows, next_rows=rows, num_owned=running, num_rows=running, num_contacts=contacts
        )


def _total(counts: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.asarray(np.sum(counts, axis=0), dtype=np.int64)
