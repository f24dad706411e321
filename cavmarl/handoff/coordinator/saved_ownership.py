"""The state of a world's coordinator as words of the world's saved state.

Owners and epochs are in the rows of the vehicles. A coordinator also needs the vehicles near
borders, the vehicles that have entered and left since the last tick, and the end of its journal.
The words include the zones, so that worlds with different zones can ignore them.
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
    tick: int  # the committed tick, counted over all episodes
    switched: int  # number of changes of owner
    seen_below: int  # all smaller vehicle ids have been used in the episode
    is_stirred: int  # 1: rows have changed since ghosts were renewed
    repartition_steps_done: int  # number of steps begun, if zones may change
    # The next six fields are described in `BorderRecords`.
    near_tick: int
    acknowledged: int
    aborted: int
    crossed: int
    owned: int
    known: int
    journal: JournalPlace  # the end of the journal

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
    counts: Words  # (k,) number of vehicles of each zone; vehicles are in the order of zones
    numbers: OwnershipNumbers
    seen: Words  # (n,) further vehicle ids that have been used in the episode
    births: Words  # (n, 2) vehicle and zone of entered vehicles that are not recorded yet
    gone: Words  # (n, 4) vehicle, reason, zone and epoch of left vehicles that are not recorded yet
    near: NDArray[np.void]  # NEAR (n,)
    coming: NDArray[np.void]  # COMING (n,)
    before: NDArray[np.void]  # COMING (n,) of the tick before

    def pack(self) -> Words:
        """Return the state as words: the number of rows of each part, then the parts."""
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
        """Read words that `pack` returned, possibly padded with zeros. All zeros give None.

        Raises:
            ConfigError: the words are damaged.
        """
        if not words.any():
            return None
        lengths = words[: len(_COLUMNS)]
        wide = [
            length * columns
            for length, columns in zip(lengths.tolist(), _COLUMNS.values(), strict=False)
        ]
        if min(wide) < 0 or len(lengths) < len(_COLUMNS) or sum(wide) > len(words) - len(lengths):
            raise _damaged("its parts are longer than the whole")
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
        capacity: int,  # largest number of vehicles in a world
    ) -> None:
        """Check that the state is consistent with these vehicles and zones.

        Raises:
            ConfigError: the state is not consistent.
        """
        numbers, counts, near = self.numbers, self.counts, self.near
        births, gone = self.births, self.gone
        if len(counts) != zones or (counts < 0).any() or counts.sum() != len(vehicles):
            raise _damaged(f"the zones own {counts.tolist()} of {len(vehicles)} vehicles")
        if max(map(len, (near, self.coming, self.before))) > 2 * capacity:
            raise _damaged("more vehicles are near borders than a world can hold")
        if abs(numbers.owned - len(vehicles)) > len(births) + len(gone):
            raise _damaged(f"it describes {numbers.owned} vehicles, not {len(vehicles)}")
        if numbers.episode < -1 or min(numbers[1:-1]) < 0 or numbers.is_stirred > 1:
            raise _damaged(f"{numbers} has a number outside of its range")
        of_zones = (
            births[:, 1], gone[:, 2], near["source"], near["target"],
            self.coming["target"], self.before["target"],
        )  # fmt: skip
        if any(((column < 0) | (column >= zones)).any() for column in of_zones):
            raise _damaged(f"it names a zone that is not one of {zones}")
        if ((near["row"] < 0) | (near["row"] >= counts[near["source"]])).any():
            raise _damaged("a vehicle near a border has no row in its zone")
        firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        if (vehicles["id"][firsts[near["source"]] + near["row"]] != near["vehicle"]).any():
            raise _damaged("a vehicle near a border has the row of another vehicle")
        if len(np.setdiff1d(births[:, 0], np.union1d(vehicles["id"], gone[:, 0]))):
            raise _damaged("a vehicle that has entered is missing")
        pairs = np.array([near["vehicle"], near["target"]])[:, near["crossed"]].T.tolist()
        known = np.array([self.coming["vehicle"], self.coming["target"]]).T.tolist()
        if any(pair not in known for pair in pairs):
            raise _damaged("a vehicle that has crossed a border was not near it")

    def partition(self) -> ZonePartition:
        """Return the zones of the state.

        Raises:
            ConfigError: the zones are invalid.
        """
        if len(self.zones) < 2:
            raise _damaged("it has no zones")
        min_x, min_y, max_x, max_y = self.zones[0].tolist()
        return ZonePartition((min_x, min_y, max_x, max_y), self.zones[1:])


def without_journal(words: Words) -> Words:
    """Return one world's packed state (1, n) without its place in a journal, for a file."""
    saved = SavedOwnership.unpack(words[0])
    if saved is None:
        return words
    numbers = saved.numbers._replace(journal=JournalPlace.nowhere())
    return saved._replace(numbers=numbers).pack()[np.newaxis]


def zone_table(partition: ZonePartition) -> NDArray[np.float64]:
    """Return the zones of a partition in the form of `SavedOwnership.zones`."""
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


def _damaged(problem: str) -> ConfigError:
    return ConfigError(
        f"the ownership in the saved state is damaged: {problem}; use an intact state"
    )
