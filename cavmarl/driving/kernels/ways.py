"""Ways: how a vehicle gets on from the end of a lane.

All plans lie in one table, `Travel.steps`. A vehicle's `way` says where in it: the step of a lane
outside junctions is `steps[way + lane]`. The plan of a goal covers every lane, so its way never
changes. An explicit route has steps for its own edges only, one edge after the other; each step
says by how much the way shifts on the next edge. Inside junctions lanes have one successor.
"""

from __future__ import annotations

import numpy as np

from cavmarl.core.numba import inlined_kernel
from cavmarl.core.records.arrays import RoadArrays, Travel


@inlined_kernel
def own_step(roads: RoadArrays, row: np.void) -> int:
    """Where in `Travel.steps` a vehicle is: at its lane's step, in a junction at the next one's."""
    lane = row["lane"]
    if roads.lanes[lane]["internal"]:
        lane = roads.links[roads.lanes[lane]["link"]]["to_lane"]
    return int(row["way"] + lane)


@inlined_kernel
def leave(roads: RoadArrays, step: np.void, lane: int, way: int) -> tuple[int, int, int]:
    """`next_step` from the lane that a vehicle is on, whose own step is known."""
    if roads.lanes[lane]["internal"]:
        return roads.lanes[lane]["successor"], way, -1
    return step["next"], way + step["shift"], step["link"]


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
def way_left(roads: RoadArrays, row: np.void, step: np.void) -> float:
    """Metres from a vehicle's centre to the end of its way; inf where it has none.

    `step` is its own one.
    """
    here = roads.lanes[row["lane"]]
    left = -row["s"]
    if here["internal"]:
        left += roads.links[here["link"]]["length_m"] - here["link_offset_m"]
    return float(step["to_go"] + left)
