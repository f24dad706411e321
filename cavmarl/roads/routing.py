"""Plans: for each goal, the lane-level way from everywhere.

A plan is a table over all lanes and not a list of edges: a vehicle that misses a turn, or is made
to change lanes, has a new way at once, and a record that migrates carries its way as one number.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RouteError
from cavmarl.core.records import record
from cavmarl.core.records.arrays import LaneGrid, RoadArrays
from cavmarl.roads.kernels.plans import plan_goal
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork

PLAN = record(
    ("next", np.int32),  # LANE after this lane's end; -1: the goal's own lane, or no way
    ("link", np.int32),  # LINK that leads there; -1 inside junctions
    ("shift", np.int32),  # what to add to a vehicle's way there, see `kernels.ways`
    ("change", np.int16),  # side of the better lane: 1 left, -1 right, 0 this one is best
    ("changes", np.int16),  # lane changes to the best lane of this edge
    ("turnarounds", np.int16),  # U-turns on the way: where a road ends, plans turn round
    # m from the lane's start that can be driven before a change is needed
    ("room", np.float64),
    ("to_go", np.float64),  # m from the lane's start to the end of the goal edge; inf: no way
)


def make_plans(
    network: RoadNetwork,
    goal_edges: Sequence[int],
    vehicle_class: str = "passenger",
    roads: RoadArrays | None = None,
) -> NDArray[np.void]:
    """The plans of several goals.

    `goal_edges`: EDGE rows to plan for. `vehicle_class`: one of `VEHICLE_CLASSES`; lanes that
    forbid it are not used. `roads`: in the place of the network's.

    Returns PLAN (len(goal_edges), num_lanes), read-only.
    """
    plans = np.zeros((len(goal_edges), len(network.lanes)), dtype=PLAN)
    permission = 1 << VEHICLE_CLASSES.index(vehicle_class)
    for goal, edge in enumerate(goal_edges):
        plan_goal(
            network.arrays if roads is None else roads, int(edge), permission, 1.0, plans[goal]
        )
    plans.setflags(write=False)
    return plans


def way(network: RoadNetwork, plan: NDArray[np.void], lane: int) -> list[int]:
    """The lanes from `lane` to the goal of one plan (L,), both included, with lane changes.

    Raises RouteError: the goal cannot be reached from there.
    """
    if not np.isfinite(plan[lane]["to_go"]):
        raise RouteError(
            f"{network.name}: no way from lane '{network.lane_ids[lane]}' to the goal; "
            "`cavmarl map check` shows which part of the map is strongly connected"
        )
    lanes = [lane]
    while True:
        step = plan[lanes[-1]]
        if step["change"] != 0:
            side = "left" if step["change"] > 0 else "right"
            lanes.append(int(network.lanes[lanes[-1]][side]))
        elif step["next"] >= 0:
            lanes.append(int(step["next"]))
        else:
            return lanes


@lru_cache(maxsize=1)  # the shards of a world are made one after the other, of one network
def lane_grid(network: RoadNetwork, cell_m: float = 25.0) -> LaneGrid:
    """Cells of `cell_m` over the map with the lanes whose surface may reach into each."""
    min_x, min_y, max_x, max_y = (float(bound) for bound in network.extent_m)
    margin = float(network.lanes["width_m"].max()) + 2.0
    min_x, min_y = min_x - margin, min_y - margin
    num_x = int((max_x + margin - min_x) // cell_m) + 1
    num_y = int((max_y + margin - min_y) // cell_m) + 1
    members: list[set[int]] = [set() for _ in range(num_x * num_y)]
    for lane, row in enumerate(network.lanes):
        line = network.lane_polyline(lane)
        for (x0, y0, _), (x1, y1, _) in pairwise(line):
            # Pieces no longer than a cell: the boxes of long diagonal segments would cover the map.
            pieces = int(np.hypot(x1 - x0, y1 - y0) // cell_m) + 1
            xs = np.linspace(x0, x1, pieces + 1)
            ys = np.linspace(y0, y1, pieces + 1)
            reach = 0.5 * float(row["width_m"]) + 2.0
            for k in range(pieces):
                left = int((min(xs[k], xs[k + 1]) - reach - min_x) // cell_m)
                right = int((max(xs[k], xs[k + 1]) + reach - min_x) // cell_m)
                low = int((min(ys[k], ys[k + 1]) - reach - min_y) // cell_m)
                high = int((max(ys[k], ys[k + 1]) + reach - min_y) // cell_m)
                for line_ in range(max(low, 0), min(high, num_y - 1) + 1):
                    for column in range(max(left, 0), min(right, num_x - 1) + 1):
                        members[line_ * num_x + column].add(lane)
    start = np.zeros(num_x * num_y + 1, dtype=np.int32)
    start[1:] = np.cumsum([len(cell) for cell in members])
    lanes = np.array([lane for cell in members for lane in sorted(cell)], dtype=np.int32)
    start.setflags(write=False)
    lanes.setflags(write=False)
    return LaneGrid(min_x, min_y, cell_m, num_x, num_y, start, lanes)
