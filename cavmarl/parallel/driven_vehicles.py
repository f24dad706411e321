"""What is told of agents' vehicles to drivers outside the process."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cavmarl.engine.simulation import Simulation


class Driven(NamedTuple):
    """An agent's vehicle, as plain numbers."""

    agent: int  # index of it
    vehicle_id: int
    vclass: int  # index into `roads.network.VEHICLE_CLASSES`
    length_m: float  # of its body
    width_m: float  # of its body
    goal_edge: int  # EDGE row of where it is to go


def driven_by(simulation: Simulation, world: int, agents: Sequence[int]) -> list[Driven]:
    """The vehicles of agents, in no order; agents without one are left out."""
    rows = simulation.vehicles(world)
    rows = rows[np.isin(rows["agent"], agents)]
    columns = (
        rows["agent"],
        rows["id"],
        simulation.types["vclass"][rows["vtype"]],
        rows["length"].astype(np.float64),
        rows["width"].astype(np.float64),
        simulation.goal_edges[rows["goal"]],
    )
    return [Driven(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]
