"""`Trips`: how the last trips of a run went."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import TERMS
from cavmarl.learning.log import WINDOW

ARRIVAL, COLLISION, OFF_ROAD = (TERMS.index(t) for t in ("arrival", "collision", "off_road"))


class Trips:
    """Returns and ends of the last `WINDOW` trips, and those under way in W worlds, A agents."""

    def __init__(self, num_envs: int, num_agents: int) -> None:
        self._returns = np.zeros((num_envs, num_agents))
        self._ended: deque[list[float]] = deque(maxlen=WINDOW)
        self._count = 0

    def add(
        self, rewards: NDArray[Any], done: NDArray[Any], cut: NDArray[Any], terms: NDArray[Any]
    ) -> None:
        """Take in one step; `done` (W, A) ends trips, `cut` (W, A) forgets them."""
        self._returns += rewards
        ends = terms[done][:, [ARRIVAL, COLLISION, OFF_ROAD]]
        self._ended.extend(np.column_stack([self._returns[done], ends]).tolist())
        self._count += len(ends)
        self._returns[done | cut] = 0.0

    def means(self) -> dict[str, float]:
        """Of the last trips; and how many there have been."""
        names = ("trip_return", "success", "collision", "off_road")
        columns = np.array(self._ended).mean(axis=0) if self._ended else np.full(4, np.nan)
        return {"trips": self._count, **dict(zip(names, columns.tolist(), strict=True))}
