"""`RowStream`: what two nodes tell each other about the rows of each tick.

Both ends keep the ghosts of the frame before; a frame has the words that have changed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError
from cavmarl.core.numba.specialized import specialized
from cavmarl.core.records.arrays import Gate, Zoned
from cavmarl.parallel.nodes.link import Bytes
from cavmarl.zones.kernels.row_frames import (
    AFTER,
    ID,
    MOST,
    NO_FRAME,
    Both,
    pack_frame,
    take_frame,
)

Array = NDArray[Any]


class _Room:
    """Ghosts of two frames: the one before, and the present one."""

    def __init__(self, words: int) -> None:  # of a ghost
        self._before, self._now = (np.empty((0, words), dtype=np.int64) for _ in range(2))
        self._num = 0

    @property
    def before(self) -> Array:
        return self._before[: self._num]

    def now(self, num: int = 0) -> Array:
        """Room for so many, at least."""
        if len(self._now) < num:
            self._now = np.empty((num + num // 2, self._now.shape[1]), dtype=np.int64)
        return self._now

    def turn(self, num: int) -> None:
        """So many that have been written are those before from now on."""
        self._before, self._now, self._num = self._now, self._before, num


class RowStream:
    """Between this node and another one."""

    def __init__(
        self,
        zoned: Zoned,
        zones: NDArray[np.int64],  # of this node
        others: NDArray[np.int64],  # of the other one
        running: NDArray[np.int64],  # (W,) see `Both`
        rerouted: NDArray[np.int64],  # (W,) likewise
    ) -> None:
        rows, steps = words_of(zoned.rows), words_of(zoned.step)
        self._both = Both(zoned, rows, steps, zones, others, running, rerouted)
        self._row = rows.shape[-1]
        size = self._row + steps.shape[-1] + AFTER
        assert size <= MOST
        assert zoned.rows["id"].ctypes.data - zoned.rows.ctypes.data == 8 * ID
        self._sent, self._taken = _Room(size), _Room(size)
        self._slots = np.empty(1, dtype=np.int32)
        self._make_frame(1 + (3 + 2 * len(others)) * running.size)
        self._pack = specialized(pack_frame, checks=False)
        self._take = specialized(take_frame, checks=False)

    def packed(self, side: int, gate: Gate, passing: Array) -> Bytes:
        """The frame that the other one gets, until the next is packed.

        Args:
            side: of the rows whose ghosts are sent.
            gate: what leaves.
            passing: the words of its rows.
        """
        sent = self._sent
        before = sent.before
        if self._slots.size < 2 * len(before):
            self._slots = np.empty(1 << (2 * len(before)).bit_length(), dtype=np.int32)
        while True:
            now, frame = sent.now(), self._frame
            num = self._pack(self._both, side, gate, passing, before, self._slots, now, frame)
            if num >= 0:
                break
            ghosts = -1 - num
            words = ghosts * (2 + sent.now(ghosts).shape[1])
            words += int(gate.num_passing.sum()) * self._row
            self._make_frame(frame.size + words + words // 2)
        sent.turn(num)
        return self._bytes[: 8 * frame.item(0)]

    def _make_frame(self, words: int) -> None:
        """Make room for a frame."""
        self._frame = np.empty(words, dtype=np.int64)
        self._bytes = self._frame.view(np.uint8).data

    def take(self, data: memoryview, side: int, gate: Gate, passing: Array) -> None:
        """Take a frame of the other one.

        Raises:
            MessageError: it is none, or there is no room for what it has.
        """
        taken, whole = self._taken, len(data) // 8
        frame = np.frombuffer(data, np.int64, whole) if whole else np.zeros(1, dtype=np.int64)
        num = NO_FRAME
        if 8 * whole == len(data):
            args = self._both, side, gate, passing, taken.before
            num = self._take(*args, taken.now(), frame)
            if NO_FRAME < num < 0:
                num = self._take(*args, taken.now(-1 - num), frame)
        if num < 0:
            raise MessageError(f"{len(data)} bytes are not what a node tells of the rows of a tick")
        taken.turn(num)


def words_of(rows: Array) -> Array:
    """(…, words) records as whole numbers of 8 bytes, a view."""
    return rows.view(np.int64).reshape(*rows.shape, -1)
