"""Message statistics of each episode, for the tables of evaluations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.env.vector import CavVectorEnv

MESSAGE_COLUMNS = ("v2x_reception_ratio", "v2x_latency_s", "v2x_busy_ratio")


class MessageRecord:
    """Keeps the counts of each world up to the last step before its episode is over.

    Args:
        vec: the worlds; without messages nothing is kept.
    """

    def __init__(self, vec: CavVectorEnv) -> None:
        self._bus = vec.simulation.messages if vec.config.v2x.enabled else None
        self._values = np.full((vec.num_envs, len(MESSAGE_COLUMNS)), np.nan)

    def add(self, running: NDArray[np.bool_]) -> None:
        """Note the worlds (W,) whose episode goes on."""
        if self._bus is None:
            return
        for world in np.flatnonzero(running).tolist():
            found = self._bus.statistics(world).to_dict()
            self._values[world] = [found[name] for name in MESSAGE_COLUMNS]

    def write(self, episodes: NDArray[np.void]) -> None:
        """Fill the columns of EPISODE (n,), of the first n worlds; NaN: there are no messages."""
        for column, name in enumerate(MESSAGE_COLUMNS):
            episodes[name] = self._values[: len(episodes), column]
