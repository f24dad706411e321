"""`GhostStream`: the ghosts that go to another node and come from it, tick by tick.

Both ends keep the ghosts of the frame before; a frame has the words that have changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError
from cavmarl.core.numba.specialized import specialized
from cavmarl.core.records.arrays import Zoned
from cavmarl.parallel.nodes.links import Bytes
from cavmarl.zones.kernels.ghost_frames import (
    AFTER,
    ID,
    MOST,
    count_ghosts,
    pack_ghosts,
    take_ghosts,
)

Array = NDArray[Any]


class _Room:
    """Ghosts of two frames, the present one and the one before."""

    def __init__(self, words: int) -> None:  # of a ghost
        self._sides = [np.empty((0, words), dtype=np.int64) for _ in range(2)]
        self.before = self.now = self._sides[0]

    def turn(self, total: int) -> None:
        """The present ones are those before from now on; room for so many."""
        self.before = self.now
        self._sides.reverse()
        if len(self._sides[0]) < total:
            self._sides[0] = np.empty((total + total // 2, self.now.shape[1]), dtype=np.int64)
        self.now = self._sides[0][:total]


class GhostStream:
    """Between this node and another one."""

    def __init__(
        self,
        zoned: Zoned,
        zones: NDArray[np.int64],  # of this node
        others: NDArray[np.int64],  # of the other one
    ) -> None:
        self._zoned, self._zones, self._others = zoned, zones, others
        rows, steps = (
            array.view(np.int64).reshape(*array.shape, -1) for array in (zoned.rows, zoned.step)
        )
        self._words = (rows, steps, zoned.step_at)
        self._size = rows.shape[-1] + steps.shape[-1] + AFTER
        assert self._size <= MOST
        assert zoned.rows["id"].ctypes.data - zoned.rows.ctypes.data == 8 * ID
        self._sent, self._taken = _Room(self._size), _Room(self._size)
        self._slots = np.empty(1, dtype=np.int32)
        self._like = np.empty(0, dtype=np.int64)
        self._bits = np.empty(0, dtype=np.uint64)
        self._changed = np.empty(0, dtype=np.int64)
        num_worlds = zoned.num_owned.shape[1]
        self._counts = np.empty((len(others), num_worlds, 2), dtype=np.int64)
        self._shape = (len(zones), num_worlds, 2)
        self._count = specialized(count_ghosts)
        self._pack = specialized(pack_ghosts)
        self._take = specialized(take_ghosts)

    def packed(self, side: int) -> list[Bytes]:
        """The ghosts that the other one gets, until the next are packed."""
        sent, counts = self._sent, self._counts
        total = self._count(self._zoned, self._others, counts)
        sent.turn(total)
        if len(self._like) < total:
            room = total + total // 2
            self._like = np.empty(room, dtype=np.int64)
            self._bits = np.empty(room, dtype=np.uint64)
            self._changed = np.empty(room * self._size, dtype=np.int64)
        if self._slots.size < 2 * len(sent.before):
            self._slots = np.empty(1 << (2 * len(sent.before)).bit_length(), dtype=np.int32)
        num = self._pack(
            *self._words, side, self._others, counts, sent.before, self._slots, sent.now,
            self._like, self._bits, self._changed,
        )  # fmt: skip
        pieces: Sequence[Array] = (
            counts.reshape(-1), self._like[:total], self._bits[:total], self._changed[:num],
        )  # fmt: skip
        return [np.int64(num).tobytes(), *(piece.view(np.uint8).data for piece in pieces)]

    def take(self, data: memoryview, side: int) -> int:
        """Take those of a frame of the other one; where in it they end.

        Raises:
            MessageError: the words are not those of so many ghosts.
        """
        taken, size = self._taken, 8 * self._shape[0] * self._shape[1] * 2
        num = int.from_bytes(data[:8], "little")
        counts = np.frombuffer(data, np.int64, size // 8, 8).reshape(self._shape)
        total = int(counts[:, :, 0].sum())
        at = 8 + size
        like = np.frombuffer(data, np.int64, total, at)
        bits = np.frombuffer(data, np.uint64, total, at + 8 * total)
        words = np.frombuffer(data, np.int64, num, at + 16 * total)
        taken.turn(total)
        if not self._take(
            self._zoned, *self._words, side, self._zones, counts, taken.before, taken.now, like,
            bits, words,
        ):  # fmt: skip
            raise MessageError(f"a frame of {total} ghosts cannot have {num} words")
        return int(at + 16 * total + 8 * num)
