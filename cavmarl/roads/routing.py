"""Plans: for each goal, the lane-level route from every lane.

A plan is a table over all lanes, not a list of edges. A vehicle that misses a turn or changes lanes
has a new route at once. When a vehicle moves to another zone, one number describes its route.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RouteError
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.records import record
from cavmarl.core.records.arrays import LaneGrid, RoadArrays
from cavmarl.roads.kernels.plans import plan_goal
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork

PLAN = record(
    ("next", np.int32),  # LANE after this lane's end; -1: lane of the goal, or no route
    ("link", np.int32),  # LINK that leads to `next`; -1 inside junctions
    ("shift", np.int32),  # change of VEHICLE["way"] on `next`, see `lanes.route_following`
    ("change", np.int16),  # side of the better lane: 1 left, -1 right, 0: this lane is best
    ("changes", np.int16),  # number of lane changes to the best lane of this edge
    ("turnarounds", np.int16),  # U-turns on the route; plans use them only where roads end
    # distance from the lane's start after which a lane change is needed, m
    ("room", np.float64),
    ("to_go", np.float64),  # m from the lane's start to the end of the goal edge; inf: no route
)


def make_plans(
    network: RoadNetwork,
    goal_edges: Sequence[int],
    vehicle_class: str = "passenger",
    roads: RoadArrays | None = None,
) -> NDArray[np.void]:
    """Return the plans of several goals.

    `goal_edges`: EDGE rows of the goals. `vehicle_class`: one of `VEHICLE_CLASSES`; lanes that
    forbid this class are not used. `roads`: arrays to use instead of the network's arrays.

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
    """Return the lanes from `lane` to the goal of a plan (L,), both included, with lane changes.

    Raises RouteError: the goal cannot be reached from `lane`.
    """
    if not np.isfinite(plan[lane]["to_go"]):
        raise RouteError(
            f"{network.name}: no route from lane '{network.lane_ids[lane]}' to the goal; "
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


@lru_cache(maxsize=1)  # the shards of a world are created in sequence from the same network
def lane_grid(network: RoadNetwork, cell_m: float = 25.0) -> LaneGrid:
    """Return a grid with cells of `cell_m` m and the lanes whose surface may reach each cell."""
    min_x, min_y, max_x, max_y = (float(bound) for bound in network.extent_m)
    margin = float(network.lanes["width_m"].max()) + 2.0
    min_x, min_y = min_x - margin, min_y - margin
    num_x = int((max_x + margin - min_x) // cell_m) + 1
    num_y = int((max_y + margin - min_y) // cell_m) + 1
    lanes, xs, ys = _pieces(network, cell_m)
    reach = 0.5 * network.lanes["width_m"][lanes] + 2.0
    left, right = _cells_along(xs, reach, min_x, cell_m, num_x)
    low, high = _cells_along(ys, reach, min_y, cell_m, num_y)
    piece, row = _counted(low, high)
    part, column = _counted(left[piece], right[piece])
    cells = row[part].astype(np.int64) * num_x + column
    # Sort by cell, then by lane, without duplicates.
    cell, member = np.divmod(
        np.unique(cells * len(network.lanes) + lanes[piece[part]]), len(network.lanes)
    )
    start = np.searchsorted(cell, np.arange(num_x * num_y + 1)).astype(np.int32)
    members = member.astype(np.int32)
    start.setflags(write=False)
    members.setflags(write=False)
    return LaneGrid(min_x, min_y, cell_m, num_x, num_y, start, members)


def _pieces(
    network: RoadNetwork, most_m: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return straight pieces of centre lines, at most `most_m` long: LANE row, x, y of both ends.

    Long diagonal segments are divided, because their bounding boxes would cover the map.
    """
    rows = network.lanes
    owner, first = _counted(rows["first_point"], rows["first_point"] + rows["num_points"] - 2)
    ends = [[network.points[axis][first], network.points[axis][first + 1]] for axis in ("x", "y")]
    (x0, x1), (y0, y1) = ends
    number = (hypot_all(x1 - x0, y1 - y0) // most_m).astype(np.int64) + 1
    segment, k = _counted(np.zeros_like(number), number - 1)
    along = []
    for a, b in ends:
        step = ((b - a) / number)[segment]
        until = np.where(k + 1 == number[segment], b[segment], (k + 1) * step + a[segment])
        along.append(np.stack([k * step + a[segment], until], axis=1))
    return owner[segment], along[0], along[1]


def _cells_along(
    ends: NDArray[np.float64], reach: NDArray[np.float64], least: float, cell_m: float, most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and last cell on an axis within `reach` of pieces (N, 2)."""
    first = ((ends.min(axis=1) - reach - least) // cell_m).astype(np.int64)
    last = ((ends.max(axis=1) + reach - least) // cell_m).astype(np.int64)
    return np.maximum(first, 0), np.minimum(last, most - 1)


def _counted(
    first: NDArray[Any], last: NDArray[Any]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List all numbers in ranges (both ends included): row of the range, and the number."""
    counts = np.maximum(last - first + 1, 0).astype(np.int64)
    owner = np.repeat(np.arange(len(counts)), counts)
    before = np.cumsum(counts) - counts
    return owner, np.arange(counts.sum()) - before[owner] + first[owner]
