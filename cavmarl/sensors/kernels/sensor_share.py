"""The rows of a whole world for sensor workers, and the agents that each worker senses."""

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
    """Append the owned rows of a zone to `rows`.

    `agent_arrays`: append only the rows of agents; otherwise only the rows of other vehicles.
    `num_rows`: (W,) number of rows, updated.
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
    """Copy the rows of all worlds, VEHICLE (W, C), to private memory."""
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
    """Move a worker's agents to the front; the worker owns these rows, all others are ghosts.

    Args:
        rows: VEHICLE (W, C), agents before the other vehicles.
        num_agents: (W,) number of agents.
        lines: (W, A, 2) lines [first, last) of each agent's frame that the worker writes; may be
            empty.
        spare: VEHICLE (1,), scratch.
        num_owned: (W,) overwritten with the number of owned rows.

    Returns:
        The number of owned rows in all worlds.
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
