"""`KeptLog`: a copy of what a SUMO was told, in memory that outlives the process that wrote it."""

from __future__ import annotations

import mmap

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import WorkerError
from cavmarl.parallel.memory.shared_memory import Segment
from cavmarl.traffic.sumo.sumo_history import ToldLog

FIRST_LOG_BYTES = 1 << 12
_WORD = 8


class KeptLog:
    """The log of one world as it was at one moment; it is brought up to date now and then.

    A log only grows in an episode, so what is added costs no more than what happened since the last
    time, however long the episode is.
    """

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = np.zeros(0, dtype=np.int64)
        self._episode = 0  # of the log that this process has written here; 0: nothing
        self._size = 0

    def write(self, log: ToldLog) -> None:
        """Bring it up to date. Raises OSError: there is no memory for it."""
        words = log.words
        # One word in front says how many there are: it is written last.
        self._make_room(1 + len(words))
        known = self._size if log.episode == self._episode else 0
        self._words[1 : 1 + log.HEAD] = words[: log.HEAD]
        self._words[1 + known : 1 + len(words)] = words[known:]
        self._words[0] = len(words)
        self._episode, self._size = log.episode, len(words)

    def read(self) -> NDArray[np.int64]:
        """(n,) `ToldLog.words` of the last time, a view."""
        self._map_all()
        size = self._words.item(0)
        if not ToldLog.HEAD <= size < len(self._words):
            raise WorkerError("what a worker's SUMO was told is not what was written")
        return self._words[1 : 1 + size]

    def _make_room(self, size: int) -> None:
        if not len(self._words):
            self._map_all()
        if size > len(self._words):
            pages = -(-size * _WORD * 5 // 4 // mmap.PAGESIZE)
            self._segment.grow(pages * mmap.PAGESIZE)
            self._map_all()

    def _map_all(self) -> None:
        """Map the segment as large as it is by now, whichever process extended it."""
        self._words = np.frombuffer(self._segment.map(), dtype=np.int64)
