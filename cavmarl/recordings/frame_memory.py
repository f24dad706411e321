"""`FrameMemory`: reuses the memory of frames that are already on disk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.engine.world_frame import SEEN

_SPARE = 64  # additional rows, in case the next frame is larger


class FrameMemory:
    """Hands out rows of SEEN and takes them back.

    Fresh memory pages cost more than copying the rows. One thread takes memory, and another thread
    gives it back.
    """

    def __init__(self) -> None:
        self._free: list[NDArray[np.void]] = []
        self._out: set[int] = set()  # ids of memory in use, which frames keep alive

    def take(self, count: int) -> NDArray[np.void]:
        """Return SEEN (count,) with undefined contents."""
        while self._free:
            found = self._free.pop()
            if len(found) >= count:
                break
        else:
            found = np.empty(count + _SPARE, dtype=SEEN)
        self._out.add(id(found))
        return found[:count]

    def give_back(self, rows: NDArray[np.void]) -> None:
        """Take back rows that are no longer read; ignore rows of other memory."""
        whole = rows.base
        if whole is not None and id(whole) in self._out:
            self._out.remove(id(whole))
            self._free.append(whole)
