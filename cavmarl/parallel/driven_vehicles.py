"""What is told of agents' vehicles to drivers outside the process."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cavmarl.engine.simulation import Simulation


class Driven(NamedTuple):
    """An agent's vehicle, as plain numbers.

    Attributes:
        agent: index of it.
        vehicle_id: of the vehicle.
        vclass: index into `roads.network.VEHICLE_CLASSES`.
        length_m: of its body.
        width_m: of its body.
        goal_edge: EDGE row of where it is to go.
    """

    agent: int
    vehicle_id: int
    vclass: int
    length_m: float
    width_m: float
    goal_edge: int


def driven_by(simulation: Simulation, world: int, agents: Sequence[int]) -> list[Driven]:
    """The vehicles of agents, in no order; agents without one are left out.

    Args:
        simulation: the worlds.
        world: which one.
        agents: indices.
    """
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
