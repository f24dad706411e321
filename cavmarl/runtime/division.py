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
from cavmarl.kernels.arrays import Worlds, Zoned
from cavmarl.kernels.exchange import adopt, exchange, find_movers, release, take_own
from cavmarl.kernels.repeated import repeated
from cavmarl.kernels.zones import Halo, ZoneArrays, zone_of
from cavmarl.shard.shard import Shard

__all__ = ["Division", "ZoneLoads"]

BORDER_M = 0.0  # whoever is so near another zone is looked at by `migrate`: who lies in one


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
        zoned: their rows.
        zones: of the partition.
        halo: how far each zone sees over its borders.
        touching_m: no ghost further outside of a zone can touch one of its vehicles.
        hysteresis_m: so far behind its border a vehicle changes its zone.
    """

    def __init__(
        self,
        shards: Sequence[Shard],
        zoned: Zoned,
        zones: ZoneArrays,
        halo: Halo,
        touching_m: float,
        hysteresis_m: float,
    ) -> None:
        self._shards = tuple(shards)
        self._zoned = zoned
        self._first_side = shards[0].worlds.rows
        self._zones = zones
        self._halo = halo
        self._touching_m = touching_m
        self._hysteresis_m = hysteresis_m
        self._migrations = 0
        capacity = shards[0].worlds.rows.shape[1]
        self._movers = np.zeros((capacity, 2), dtype=np.int32)
        self._spare = np.zeros(1, dtype=shards[0].worlds.rows.dtype)
        self._call_exchange = repeated(exchange)
        self._find_movers = repeated(find_movers)

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
            self._exchange(first.rows, w, w + 1)

    def exchange(self) -> None:
        """Renew all ghosts from the owned `next_rows`."""
        worlds = self._shards[0].worlds
        self._exchange(worlds.next_rows, 0, len(worlds.ticks))

    def _exchange(self, rows: NDArray[np.void], first: int, last: int) -> None:
        """Renew the ghosts of some worlds; `rows` are the first shard's rows or next ones."""
        self._call_exchange(
            self._zones,
            self._halo,
            self._touching_m,
            BORDER_M,
            self._zoned,
            self._side(rows),
            first,
            last,
        )

    def _side(self, rows: NDArray[np.void]) -> int:
        return 0 if rows is self._first_side else 1

    def migrate(self) -> None:
        """Let the vehicles of `next_rows` that had left their zone at `exchange` change owners."""
        if len(self._shards) == 1:
            return
        side = self._side(self._shards[0].worlds.next_rows)
        for w in range(len(self._shards[0].worlds.ticks)):
            found = self._find_movers(
                self._zones, self._hysteresis_m, self._zoned, side, w, self._movers
            )
            self._migrations += found
            # From the last row to the first: who is released is swapped with the last owned one.
            for zone, row in self._movers[:found][::-1].tolist():
                self._let_go(self._shards[zone].worlds, w, row)

    def _let_go(self, source: Worlds, w: int, row: int) -> None:
        rows = source.next_rows[w]
        zone = zone_of(self._zones, rows[row]["x"], rows[row]["y"])
        target = self._shards[zone].worlds
        if not adopt(
            target.next_rows[w], int(target.num_owned[w]), int(target.num_rows[w]), rows[row]
        ):
            raise ZoneError(
                f"vehicle {rows[row]['id']} entered zone {zone}, which has not seen it come: "
                "the halo is too narrow"
            )
        target.num_owned[w] += 1
        release(rows, row, int(source.num_owned[w]), self._spare)
        source.num_owned[w] -= 1

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
