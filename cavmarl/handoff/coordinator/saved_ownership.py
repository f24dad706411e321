"""What decides the next changes of owner in one world, as words of its saved state.

Owners and epochs are in the rows of the vehicles. Beside them a coordinator has to know which
vehicles stand near a border, which have come and gone since the last tick, and where its journal
ends. The words name the zones, so that a reader with other zones can leave them out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.handoff.coordinator.journal import JournalPlace
from cavmarl.zones.kernels.borders import NEAR
from cavmarl.zones.kernels.ownership_changes import COMING
from cavmarl.zones.partition.zone_partition import ZonePartition

Words = NDArray[np.int64]

_NEAR = ("vehicle", "source", "row", "target", "crossed", "depth_m")
_COMING = ("vehicle", "target", "epoch", "tick", "depth_m")
_COLUMNS = {
    "zones": 4, "counts": 1, "numbers": 1, "seen": 1, "births": 2, "gone": 4,
    "near": len(_NEAR), "coming": len(_COMING), "before": len(_COMING),
}  # fmt: skip


class OwnershipNumbers(NamedTuple):
    """The single numbers of a coordinator's state."""

    episode: int
    tick: int  # that is committed, of all episodes
    switched: int  # vehicles that have changed their owner
    seen_below: int  # all smaller ids have been in the episode
    is_stirred: int  # 1: rows have changed since the ghosts were renewed
    repartition_steps_done: int  # that the worlds have made, where zones are cut anew
    # of the borders' records; see `BorderRecords`
    near_tick: int
    acknowledged: int
    aborted: int
    crossed: int
    owned: int
    known: int
    # where the journal ends; the first is -1: there is none
    journal: JournalPlace

    @classmethod
    def of(cls, numbers: Words) -> OwnershipNumbers:
        *plain, lines, checksum, size = numbers.tolist()
        return cls._make([*plain, JournalPlace(lines, checksum, size)])

    def words(self) -> Words:
        return np.array([*self[:-1], *self.journal], dtype=np.int64)


NUM_NUMBERS = len(OwnershipNumbers._fields) - 1 + len(JournalPlace._fields)


class SavedOwnership(NamedTuple):
    """The state of the coordinator of one world, between two ticks."""

    zones: NDArray[np.float64]  # (1 + k, 4) bounds of the partition, and the rectangle of each zone
    counts: Words  # (k,) how many of the vehicles each zone owns; they come in the order of zones
    numbers: OwnershipNumbers
    seen: Words  # (n,) further ids that have been in the episode
    births: Words  # (n, 2) vehicle and zone, of those that are not on record yet
    gone: Words  # (n, 4) vehicle, reason, its zone and epoch, of those that have left meanwhile
    near: NDArray[np.void]  # NEAR (n,)
    coming: NDArray[np.void]  # COMING (n,)
    before: NDArray[np.void]  # COMING (n,) of the tick before

    def pack(self) -> Words:
        """All of it as words: how many rows each part has, then the parts."""
        parts = (
            self.zones.view(np.int64),
            self.counts,
            self.numbers.words(),
            self.seen,
            self.births,
            self.gone,
            _words_of(self.near, _NEAR),
            _words_of(self.coming, _COMING),
            _words_of(self.before, _COMING),
        )
        head = np.array([len(part) for part in parts], dtype=np.int64)
        return np.concatenate([head, *(part.reshape(-1) for part in parts)])

    @classmethod
    def unpack(cls, words: Words) -> SavedOwnership | None:
        """Read what `pack` returned, with zeros behind it or not; None: there is nothing.

        Raises:
            ConfigError: it was something else.
        """
        if not words.any():
            return None
        lengths = words[: len(_COLUMNS)]
        wide = [
            length * columns
            for length, columns in zip(lengths.tolist(), _COLUMNS.values(), strict=False)
        ]
        if min(wide) < 0 or len(lengths) < len(_COLUMNS) or sum(wide) > len(words) - len(lengths):
            raise _damaged("its parts do not fit into it")
        parts, at = {}, len(lengths)
        for (name, columns), size in zip(_COLUMNS.items(), wide, strict=True):
            part = np.ascontiguousarray(words[at : at + size])
            parts[name] = part if columns == 1 else part.reshape(-1, columns)
            at += size
        if len(parts["numbers"]) != NUM_NUMBERS:
            raise _damaged(f"it has {len(parts['numbers'])} numbers, not {NUM_NUMBERS}")
        return cls(
            zones=parts["zones"].view(np.float64),
            counts=parts["counts"],
            numbers=OwnershipNumbers.of(parts["numbers"]),
            seen=parts["seen"],
            births=parts["births"],
            gone=parts["gone"],
            near=_records_of(parts["near"], NEAR, _NEAR),
            coming=_records_of(parts["coming"], COMING, _COMING),
            before=_records_of(parts["before"], COMING, _COMING),
        )

    def check(
        self,
        vehicles: NDArray[np.void],  # VEHICLE (n,) in the order of zones
        zones: int,
        capacity: int,  # of vehicles of a world
    ) -> None:
        """See that it is about these vehicles of so many zones, and names no others.

        Raises:
            ConfigError: it does not.
        """
        numbers, counts, near = self.numbers, self.counts, self.near
        births, gone = self.births, self.gone
        if len(counts) != zones or (counts < 0).any() or counts.sum() != len(vehicles):
            raise _damaged(f"zones own {counts.tolist()} of {len(vehicles)} vehicles")
        if max(map(len, (near, self.coming, self.before))) > 2 * capacity:
            raise _damaged("more vehicles are near borders than there can be")
        if numbers.episode < -1 or min(numbers[1:-1]) < 0 or numbers.is_stirred > 1:
            raise _damaged(f"{numbers} has a number out of its range")
        of_zones = (
            births[:, 1], gone[:, 2], near["source"], near["target"],
            self.coming["target"], self.before["target"],
        )  # fmt: skip
        if any(((column < 0) | (column >= zones)).any() for column in of_zones):
            raise _damaged(f"it names a zone that is none of {zones}")
        if ((near["row"] < 0) | (near["row"] >= counts[near["source"]])).any():
            raise _damaged("a vehicle near a border stands in no row of its zone")
        firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        if (vehicles["id"][firsts[near["source"]] + near["row"]] != near["vehicle"]).any():
            raise _damaged("a vehicle near a border stands in another's row")
        if len(np.setdiff1d(births[:, 0], np.union1d(vehicles["id"], gone[:, 0]))):
            raise _damaged("a vehicle that has entered is not there")
        pairs = np.array([near["vehicle"], near["target"]])[:, near["crossed"]].T.tolist()
        known = np.array([self.coming["vehicle"], self.coming["target"]]).T.tolist()
        if any(pair not in known for pair in pairs):
            raise _damaged("a vehicle that has crossed a border was not near it")

    def partition(self) -> ZonePartition:
        """Its zones.

        Raises:
            ConfigError: they are none.
        """
        if len(self.zones) < 2:
            raise _damaged("it has no zones")
        min_x, min_y, max_x, max_y = self.zones[0].tolist()
        return ZonePartition((min_x, min_y, max_x, max_y), self.zones[1:])


def without_journal(words: Words) -> Words:
    """What `pack` returned of one world, (1, n), for a file: no journal goes on from there."""
    saved = SavedOwnership.unpack(words[0])
    if saved is None:
        return words
    numbers = saved.numbers._replace(journal=JournalPlace.nowhere())
    return saved._replace(numbers=numbers).pack()[np.newaxis]


def zone_table(partition: ZonePartition) -> NDArray[np.float64]:
    """The zones of a partition as `SavedOwnership` has them."""
    return np.concatenate([np.array([partition.bounds]), partition.rects])


def _words_of(records: NDArray[np.void], names: tuple[str, ...]) -> Words:
    words = np.empty((len(records), len(names)), dtype=np.int64)
    for n, name in enumerate(names):
        column = np.ascontiguousarray(records[name])
        words[:, n] = column.view(np.int64) if column.dtype == np.float64 else column
    return words


def _records_of(words: Words, dtype: np.dtype[Any], names: tuple[str, ...]) -> NDArray[np.void]:
    records = np.zeros(len(words), dtype=dtype)
    for n, name in enumerate(names):
        column = np.ascontiguousarray(words[:, n])
        records[name] = column.view(np.float64) if dtype[name] == np.float64 else column
    return records


def _damaged(what: str) -> ConfigError:
    return ConfigError(f"the state says of the owners of vehicles what cannot be: {what}")
