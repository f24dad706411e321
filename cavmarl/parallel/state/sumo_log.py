"""`KeptLog`: a copy of the commands to a SUMO process, in memory that outlives its writer."""

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
    """The log of one world as it was at the last `write`.

    Within an episode a log only grows, so a write only copies the commands since the last write.
    """

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = np.zeros(0, dtype=np.int64)
        self._episode = 0  # episode of the log that this process wrote last; 0: none
        self._size = 0

    def write(self, log: ToldLog) -> None:
        """Update the copy. Raises OSError: there is not enough memory."""
        words = log.words
        # The first word is the number of words of the log. It is written last.
        self._make_room(1 + len(words))
        known = self._size if log.episode == self._episode else 0
        self._words[1 : 1 + log.HEAD] = words[: log.HEAD]
        self._words[1 + known : 1 + len(words)] = words[known:]
        self._words[0] = len(words)
        self._episode, self._size = log.episode, len(words)

    def read(self) -> NDArray[np.int64]:
        """Return (n,) `ToldLog.words` of the last `write`, as a view.

        Raises:
            WorkerError: the copy is damaged.
        """
        self._map_all()
        size = self._words.item(0)
        if not ToldLog.HEAD <= size < len(self._words):
            raise WorkerError("the log of commands to SUMO in shared memory is damaged")
        return self._words[1 : 1 + size]

    def _make_room(self, size: int) -> None:
        if not len(self._words):
            self._map_all()
        if size > len(self._words):
            pages = -(-size * _WORD * 5 // 4 // mmap.PAGESIZE)
            self._segment.grow(pages * mmap.PAGESIZE)
            self._map_all()

    def _map_all(self) -> None:
        """Map the segment at its current size, which another process may have changed."""
        self._words = np.frombuffer(self._segment.map(), dtype=np.int64)
