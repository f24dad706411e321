"""What each process tells another one about its agents: a table row of each, as bytes.

A frame is how many agents it has, in 8 bytes; their numbers, in 8 bytes each; and then, agent by
agent, the row of each table.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel

Table = NDArray[np.uint8]
"""(A, b) b bytes of each agent."""


@kernel
def pack_agents(
    mine: NDArray[np.bool_],  # (A,) agents that are told of
    tables: tuple[Table, ...],
    words: NDArray[np.int64],  # written: the frame, with room for all agents
    data: NDArray[np.uint8],  # the same memory
) -> int:
    """Write a frame; how many bytes it has."""
    num = 0
    for agent in range(mine.size):
        if mine[agent]:
            num += 1
            words[num] = agent
    words[0] = num
    at = 8 * (1 + num)
    for n in range(num):
        for table in tables:
            row = table[words[1 + n]]
            for c in range(row.size):
                data[at + c] = row[c]
            at += row.size
    return at


@kernel
def take_agents(
    tables: tuple[Table, ...],  # written
    words: NDArray[np.int64],  # the first whole words of the frame
    data: NDArray[np.uint8],  # the frame
    number: int,  # of the process that it comes from
    owner: NDArray[np.int32],  # (A,) written: that number
) -> bool:
    """Take a frame; whether it is one that `pack_agents` makes, else nothing is written."""
    size = 8
    for table in tables:
        size += table.shape[1]
    if words.size == 0 or words[0] < 0 or words[0] > owner.size:
        return False
    num = words[0]
    if data.size != 8 + num * size:
        return False
    for n in range(num):
        if words[1 + n] < 0 or words[1 + n] >= owner.size:
            return False
    at = 8 * (1 + num)
    for n in range(num):
        owner[words[1 + n]] = number
        for table in tables:
            row = table[words[1 + n]]
            for c in range(row.size):
                row[c] = data[at + c]
            at += row.size
    return True
