"""Ways: how a vehicle gets on from the end of a lane.

All plans lie in one table, `Travel.steps`. A vehicle's `way` says where in it: the step of a lane
outside junctions is `steps[way + lane]`. The plan of a goal covers every lane, so its way never
changes. An explicit route has steps for its own edges only, one edge after the other; each step
says by how much the way shifts on the next edge. Inside junctions lanes have one successor.
"""

from __future__ import annotations

import numpy as np

from cavmarl.kernels import inlined_kernel
from cavmarl.kernels.arrays import RoadArrays, Travel

__all__ = ["next_step", "way_left"]


@inlined_kernel
def next_step(roads: RoadArrays, travel: Travel, lane: int, way: int) -> tuple[int, int, int]:
    """What follows the end of a lane: (lane, way there, link that is entered).

    The lane is -1 where the way ends or goes on from another lane; the link is -1 inside junctions.
    """
    if roads.lanes[lane]["internal"]:
        return roads.lanes[lane]["successor"], way, -1
    step = travel.steps[way + lane]
    return step["next"], way + step["shift"], step["link"]


@inlined_kernel
def way_left(roads: RoadArrays, travel: Travel, row: np.void) -> float:
    """Metres from a vehicle's centre to the end of its way; inf where it has none."""
    lane = row["lane"]
    here = roads.lanes[lane]
    left = -row["s"]
    if here["internal"]:
        link = roads.links[here["link"]]
        left += link["length_m"] - here["link_offset_m"]
        lane = link["to_lane"]
    return float(travel.steps[row["way"] + lane]["to_go"] + left)
