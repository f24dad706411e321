"""How far a shard has to see over its borders: the farthest look of drivers and of sensors.

Distances are between centres, in the plane. What is measured along a road is at least as long.
"""

from __future__ import annotations

from cavmarl.kernels.approach import APPROACH_M
from cavmarl.kernels.arrays import Travel
from cavmarl.kernels.junctions import EXIT_LOOK_M
from cavmarl.roads.network import RoadNetwork

__all__ = ["driving_reach_m"]

ASIDE_M = 10.0  # between the centres of neighbour lanes, and of vehicles beside them


def driving_reach_m(network: RoadNetwork, travel: Travel) -> float:
    """The farthest vehicle that a driver's decision can depend on.

    A driver looks `view_m` ahead and asks at a line in view who comes to the junction beyond it,
    within `APPROACH_M` of the lines there, and who stands behind it, within `EXIT_LOOK_M`. Own path
    and foe's meet somewhere on the junction: between the lines may lie the lengths of both.

    Args:
        network: the roads.
        travel: the types of vehicles, and how far they look.
    """
    links = network.links
    crossing_m = float((links["length_m"]).max()) if len(links) else 0.0
    back_m = float(network.lanes["stop_back_m"].max())
    bodies_m = 2.0 * float(travel.types["length"].max())
    beyond_m = max(APPROACH_M, EXIT_LOOK_M)
    return travel.view_m + back_m + 2.0 * crossing_m + beyond_m + bodies_m + ASIDE_M
