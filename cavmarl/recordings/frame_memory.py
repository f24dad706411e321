"""`FrameMemory`: the memory of frames that are on disk, for frames to come."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.engine.world_frame import SEEN

_SPARE = 64  # rows that a frame may have more than the one before


class FrameMemory:
    """Hands out rows of SEEN, and takes them back.

    Fresh pages cost a step more than the rows that are copied to them. One thread takes memory,
    another gives it back.
    """

    def __init__(self) -> None:
        self._free: list[NDArray[np.void]] = []
        self._out: set[int] = set()  # ids of what is handed out, which frames keep alive

    def take(self, count: int) -> NDArray[np.void]:
        """SEEN (count,), with anything in it."""
        while self._free:
            found = self._free.pop()
            if len(found) >= count:
                break
        else:
            found = np.empty(count + _SPARE, dtype=SEEN)
        self._out.add(id(found))
        return found[:count]

    def give_back(self, rows: NDArray[np.void]) -> None:
        """Rows that nothing reads any more; those of elsewhere are left alone."""
        whole = rows.base
        if whole is not None and id(whole) in self._out:
            self._out.remove(id(whole))
            self._free.append(whole)
