"""The rows of a whole world for sensor workers, and the agents that each of them senses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT


@kernel
def gather_rows(
    worlds: Worlds, agent_arrays: bool, rows: NDArray[np.void], num_rows: NDArray[np.int64]
) -> None:
    """Put the owned rows of a zone behind those that are there.

    `agent_arrays`: only those of agents; otherwise only the others. `num_rows`: (W,) how many there
    are.
    """
    for w in range(worlds.ticks.size):
        at = num_rows[w]
        for i in range(worlds.num_owned[w]):
            if (worlds.rows[w, i]["driver"] == DRIVER_AGENT) == agent_arrays:
                rows[w, at] = worlds.rows[w, i]
                at += 1
        num_rows[w] = at


@kernel
def take_rows(rows: NDArray[np.void], num_rows: NDArray[np.int64], own: NDArray[np.void]) -> None:
    """Copy the rows of all worlds, VEHICLE (W, C), to memory of one's own."""
    for w in range(num_rows.size):
        for i in range(num_rows[w]):
            own[w, i] = rows[w, i]


@kernel
def put_first(
    rows: NDArray[np.void],
    num_agents: NDArray[np.int64],
    lines: NDArray[np.int32],
    spare: NDArray[np.void],
    num_owned: NDArray[np.int64],
) -> int:
    """Put the agents that a worker senses for before the others: it owns them, the rest are ghosts.

    Args:
        rows: VEHICLE (W, C), agents before the others.
        num_agents: (W,) how many agents.
        lines: (W, A, 2) [first, last) that it writes of each agent's frame; none: others do.
        spare: VEHICLE (1,), scratch.
        num_owned: (W,) overwritten with how many are first.

    Returns:
        how many are first in all worlds.
    """
    total = 0
    for w in range(num_agents.size):
        count = 0
        for i in range(num_agents[w]):
            agent = rows[w, i]["agent"]
            if lines[w, agent, 0] >= lines[w, agent, 1]:
                continue
            if i != count:
                spare[0] = rows[w, count]
                rows[w, count] = rows[w, i]
                rows[w, i] = spare[0]
            count += 1
        num_owned[w] = count
        total += count
    return total
