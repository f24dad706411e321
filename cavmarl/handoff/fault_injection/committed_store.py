"""`CommittedStore`: all that a tick changes, as of the committed tick, and room for the next one.

A tick works on the shards' arrays and on those that they share. `write` copies what it has led to,
`flip` makes that the truth, `load` takes everything back to the truth. So whatever becomes of a
tick that is not committed, it can be begun again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import JournalError, ProtocolError
from cavmarl.core.records.arrays import Common, Zoned
from cavmarl.ownership.messages import Birth, Removed
from cavmarl.ownership.safeguards import ALL_ON, Safeguards
from cavmarl.shards.shard import Shard
from cavmarl.shards.state import Use, arrays_of, names_of

COUNTS = names_of(Zoned, Use.COMMITTED)  # of `Worlds` that each shard has of its own

Array = NDArray[Any]
Arrays = list[Array]
Notes = tuple[tuple[Birth, ...], tuple[Removed, ...]]
"""What has happened since the last BEGIN: new vehicles, and those that are gone."""


class CommittedImage(NamedTuple):
    """A copy of everything."""

    counts: list[Arrays]  # by shard, those of `COUNTS`
    rows: list[Arrays]  # by shard and world, VEHICLE (n,), owned rows and ghosts
    shared: Arrays  # what the shards have in common, and what is kept beside them
    notes: tuple[Notes, ...]  # by world


class CommittedStore:
    """Two copies of the worlds."""

    def __init__(
        self,
        shards: Sequence[Shard],  # whose rows are kept
        # the arrays beside theirs that a tick changes, as they are now
        shared: Callable[[], Iterable[Array]],
        # remedies of the protocol; without `double_buffer` there is one copy only
        safeguards: Safeguards = ALL_ON,
    ) -> None:
        self._has_two = safeguards.double_buffer
        self._shards = tuple(shards)
        self._others = shared
        self._committed: CommittedImage | None = None
        self._next: CommittedImage | None = None

    def write(self, notes: tuple[Notes, ...]) -> None:
        """Copy what there is now; the truth stays what it was."""
        counts: list[Arrays] = []
        rows: list[Arrays] = []
        for shard in self._shards:
            worlds = shard.worlds
            counts.append([getattr(worlds, name).copy() for name in COUNTS])
            rows.append([worlds.rows[w, :num].copy() for w, num in enumerate(worlds.num_rows)])
        shared = [array.copy() for array in self.shared()]
        self._next = CommittedImage(counts, rows, shared, notes)
        if not self._has_two:
            self._committed = self._next

    def flip(self) -> None:
        """Make what was written last the truth."""
        if self._next is None:
            raise ProtocolError("nothing has been written to the store since it was flipped")
        self._committed, self._next = self._next, None

    def load(self) -> tuple[Notes, ...]:
        """Take the worlds back to the truth; the notes of each."""
        image = self.truth()
        for shard, counts, rows in zip(self._shards, image.counts, image.rows, strict=True):
            worlds = shard.worlds
            for name, kept in zip(COUNTS, counts, strict=True):
                getattr(worlds, name)[:] = kept
            for w, own in enumerate(rows):
                worlds.rows[w, : len(own)] = own
        for array, kept in zip(self.shared(), image.shared, strict=True):
            array[...] = kept
        return image.notes

    def adopt(self, image: CommittedImage) -> tuple[Notes, ...]:
        """Take the worlds to what another store has kept of such worlds; the notes of each."""
        shared = list(self.shared())
        if (len(image.rows), len(image.shared)) != (len(self._shards), len(shared)):
            raise JournalError(
                f"{len(image.rows)} zones with {len(image.shared)} arrays were kept, and here are "
                f"{len(self._shards)} with {len(shared)}; use the version that wrote them"
            )
        for shard, counts, rows in zip(self._shards, image.counts, image.rows, strict=True):
            worlds = shard.worlds
            for name, kept in zip(COUNTS, counts, strict=True):
                _put(kept, getattr(worlds, name), name)
            for w, own in enumerate(rows):
                _put(own, worlds.rows[w, : len(own)], "rows")
        for number, (array, kept) in enumerate(zip(shared, image.shared, strict=True)):
            _put(kept, array, f"array {number} beside the rows")
        return image.notes

    def written(self, zone: int, world: int) -> NDArray[np.void]:
        """VEHICLE (n,), a zone's owned rows as they were written last."""
        if self._next is None:
            raise ProtocolError("nothing has been written to the store since it was flipped")
        num = int(self._next.counts[zone][COUNTS.index("num_owned")][world])
        rows: NDArray[np.void] = self._next.rows[zone][world][:num]
        return rows

    def shared(self) -> Iterator[Array]:
        yield from arrays_of(self._shards[0].worlds, Common, Use.COMMITTED)
        yield from self._others()

    def truth(self) -> CommittedImage:
        """What is committed; not to be changed."""
        if self._committed is None:
            raise ProtocolError("nothing is committed: reset the worlds first")
        return self._committed


def _put(kept: Array, array: Array, what: str) -> None:
    """Write what was kept into an array of the same meaning, which may have less room to spare."""
    if kept.dtype != array.dtype:
        raise JournalError(f"{what}: kept in another layout; use the version that wrote them")
    if kept.ndim != array.ndim or any(a < b for a, b in zip(kept.shape, array.shape, strict=True)):
        raise JournalError(f"{what}: {kept.shape} were kept, and here are {array.shape}")
    array[...] = kept[tuple(slice(length) for length in array.shape)]
