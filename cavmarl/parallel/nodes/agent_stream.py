"""`AgentStream`: what nodes tell each other about their agents, as kernels write and read it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError
from cavmarl.core.numba.specialized import specialized
from cavmarl.parallel.nodes.links import Bytes
from cavmarl.zones.kernels.agent_frames import pack_agents, take_agents


class AgentStream:
    """Rows of some tables."""

    def __init__(self, tables: Sequence[NDArray[Any]]) -> None:  # (W, A, …)
        num = tables[0].shape[0] * tables[0].shape[1]
        assert all(table.flags.c_contiguous for table in tables), "these are views of them"
        self._tables = tuple(table.reshape(-1).view(np.uint8).reshape(num, -1) for table in tables)
        size = 8 + sum(table.shape[1] for table in self._tables)
        self._words = np.empty(1 + num * -(-size // 8), dtype=np.int64)
        self._bytes = self._words.view(np.uint8)
        self._pack = specialized(pack_agents)
        self._take = specialized(take_agents)

    def packed(self, mine: NDArray[np.bool_]) -> Bytes:
        """What is told of some agents (W · A,), until the next is packed."""
        return self._bytes[: self._pack(mine, self._tables, self._words, self._bytes)].data

    def take(self, data: memoryview, number: int, owner: NDArray[np.int32]) -> None:
        """Write what node `number` tells to the tables, and that it owns these agents.

        Raises:
            MessageError: it is none, or is about agents that there are not.
        """
        if len(data) >= 8:
            found = np.frombuffer(data, np.uint8)
            words = np.frombuffer(data, np.int64, len(data) // 8)
            if self._take(self._tables, words, found, number, owner):
                return
        raise MessageError(f"{len(data)} bytes are not what a node tells of its agents")
