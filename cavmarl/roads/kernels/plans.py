"""Lane-level plans: the next step to one goal, for every lane of the map.

Dijkstra's algorithm runs backwards from the goal's lanes over the lane graph. Driving along a lane
costs the time at the speed limit. A lane change costs more on shorter lanes, so that plans change
lanes early and where there is room.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.codes import NO_CHANGE_LEFT, NO_CHANGE_RIGHT

LANE_CHANGE_COST_S = 5.0  # cost of a lane change on a very long lane, as travel time in s
LANE_CHANGE_M = 250.0  # on a lane of this length the cost doubles: drivers can barely change lanes
LEAST_CHANGE_M = 9.0  # on shorter lanes, a change always has its full cost
TURNAROUND = ord("t")


@kernel
def _is_allowed(roads: RoadArrays, link: int) -> bool:
    """Return whether plans use a link; they use turnarounds only at the ends of roads."""
    if roads.links[link]["direction"] != TURNAROUND:
        return True
    edge = roads.edges[roads.lanes[roads.links[link]["from_lane"]]["edge"]]
    for lane in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
        row = roads.lanes[lane]
        for other in range(row["first_link"], row["first_link"] + row["num_links"]):
            if roads.links[other]["direction"] != TURNAROUND:
                return False
    return True


@kernel
def _leads_to(roads: RoadArrays, before: int, lane: int) -> bool:
    """Return whether an allowed movement goes from the end of lane `before` to `lane`."""
    row = roads.lanes[before]
    if row["internal"]:
        return True
    for link in range(row["first_link"], row["first_link"] + row["num_links"]):
        if roads.links[link]["next_lane"] == lane and _is_allowed(roads, link):
            return True
    return False


@inlined_kernel
def is_barred(roads: RoadArrays, lane: int, side: int, permission: int) -> bool:
    """Return whether a solid line bars vehicles from a lane change; side: 1 left, -1 right.

    `permission`: bits of LANE["permissions"]; one bit that is not barred is enough.
    """
    barred = roads.lanes[lane]["permissions"] >> (NO_CHANGE_LEFT if side > 0 else NO_CHANGE_RIGHT)
    every: bool = (barred & permission) == permission
    return every


@kernel
def change_cost(roads: RoadArrays, lane: int, weight: float) -> float:
    """Return the cost in s of a lane change; it is higher on shorter lanes.

    Inside junctions, vehicles do not change lanes.
    """
    if roads.lanes[lane]["internal"]:
        return math.inf
    length_m = float(roads.lanes[lane]["length_m"])
    if length_m < LEAST_CHANGE_M:
        weight = max(weight, 1.0)
    return weight * LANE_CHANGE_COST_S * (1.0 + LANE_CHANGE_M / length_m)


@kernel
def _lane_cost(roads: RoadArrays, lane: int, cost: NDArray[np.float64]) -> tuple[float, int, int]:
    """Return the least cost from the start of `lane` without a change: (cost, next lane, link)."""
    row = roads.lanes[lane]
    best = math.inf
    best_next = -1
    best_link = -1
    if row["internal"]:
        best_next = row["successor"]
        best = cost[best_next]
    else:
        for link in range(row["first_link"], row["first_link"] + row["num_links"]):
            candidate = roads.links[link]["next_lane"]
            if cost[candidate] < best and _is_allowed(roads, link):
                best = cost[candidate]
                best_next = candidate
                best_link = link
    if best == math.inf:
        return math.inf, -1, -1
    return row["length_m"] / row["speed_mps"] + best, best_next, best_link


@kernel
def _settle(
    roads: RoadArrays,
    lane: int,
    goal_edge: int,
    permission: int,
    change_weight: float,
    cost: NDArray[np.float64],
    plan: NDArray[np.void],
) -> None:
    """Write the plan of a lane. The costs of the lane and of all cheaper lanes must be final."""
    row = roads.lanes[lane]
    step = plan[lane]
    length = row["length_m"]
    if row["edge"] == goal_edge:
        step["to_go"] = length
        step["room"] = length
        return
    through, next_lane, link = _lane_cost(roads, lane, cost)
    step["next"] = next_lane
    step["link"] = link
    best = through
    change = 0
    beside = -1
    sideways = change_cost(roads, lane, change_weight)
    if (
        row["left"] >= 0
        and cost[row["left"]] + sideways < best
        and not is_barred(roads, lane, 1, permission)
    ):
        best = cost[row["left"]] + sideways
        change = 1
        beside = row["left"]
    if (
        row["right"] >= 0
        and cost[row["right"]] + sideways < best
        and not is_barred(roads, lane, -1, permission)
    ):
        change = -1
        beside = row["right"]
    step["change"] = change
    if change == 0:
        step["turnarounds"] = plan[next_lane]["turnarounds"]
        if link >= 0 and roads.links[link]["direction"] == TURNAROUND:
            step["turnarounds"] += 1
        step["room"] = length + plan[next_lane]["room"]
        step["to_go"] = length + plan[next_lane]["to_go"]
    else:
        step["turnarounds"] = plan[beside]["turnarounds"]
        step["changes"] = 1 + plan[beside]["changes"]
        step["room"] = length
        step["to_go"] = plan[beside]["to_go"]


class _Search(NamedTuple):
    """State of a search: cost of each lane, and a binary heap of lanes by cost, then by row."""

    cost: NDArray[np.float64]  # (L,) cost of the cheapest known path, s
    heap: NDArray[np.int32]  # (L,) lanes that are reached but not settled
    place: NDArray[np.int32]  # (L,) index of a lane in the heap, `_UNSEEN`, or `_SETTLED`


_UNSEEN, _SETTLED = -1, -2


@kernel
def _comes_before(search: _Search, one: int, other: int) -> bool:
    if search.cost[one] != search.cost[other]:
        return bool(search.cost[one] < search.cost[other])
    return one < other


@kernel
def _put_up(search: _Search, lane: int, at: int) -> None:
    """Move a lane up in the heap from index `at`."""
    while at > 0:
        above = search.heap[(at - 1) // 2]
        if _comes_before(search, above, lane):
            break
        search.heap[at] = above
        search.place[above] = at
        at = (at - 1) // 2
    search.heap[at] = lane
    search.place[lane] = at


@kernel
def _put_down(search: _Search, lane: int, size: int) -> None:
    """Insert a lane at the empty root of a heap and move it down; `size` includes the lane."""
    at = 0
    while True:
        below = 2 * at + 1
        if below >= size:
            break
        right = below + 1
        if right < size and _comes_before(search, search.heap[right], search.heap[below]):
            below = right
        if _comes_before(search, lane, search.heap[below]):
            break
        search.heap[at] = search.heap[below]
        search.place[search.heap[at]] = at
        at = below
    search.heap[at] = lane
    search.place[lane] = at


@kernel
def _offer(search: _Search, lane: int, cost: float, size: int) -> int:
    """Update the cost of a lane if the new cost is lower; return the new size of the heap."""
    if search.place[lane] == _SETTLED or not cost < search.cost[lane]:
        return size
    search.cost[lane] = cost
    if search.place[lane] == _UNSEEN:
        _put_up(search, lane, size)
        return size + 1
    _put_up(search, lane, search.place[lane])
    return size


@kernel
def _take_first(search: _Search, size: int) -> int:
    """Remove the cheapest lane from a heap of `size` lanes, and mark it as settled."""
    first = search.heap[0]
    if size > 1:
        _put_down(search, search.heap[size - 1], size - 1)
    search.place[first] = _SETTLED
    return int(first)


@kernel
def _search_plan(
    roads: RoadArrays,
    goal_edge: int,
    permission: int,
    change_weight: float,
    plan: NDArray[np.void],
    search: _Search,
) -> None:
    for lane in range(roads.lanes.shape[0]):
        step = plan[lane]
        step["next"] = -1
        step["link"] = -1
        step["change"] = 0
        step["changes"] = 0
        step["turnarounds"] = 0
        step["shift"] = 0
        step["room"] = 0.0
        step["to_go"] = math.inf
    size = 0
    edge = roads.edges[goal_edge]
    for lane in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
        row = roads.lanes[lane]
        if row["permissions"] & permission:
            size = _offer(search, lane, row["length_m"] / row["speed_mps"], size)
    while size > 0:
        lane = _take_first(search, size)
        size -= 1
        here = search.cost[lane]
        _settle(roads, lane, goal_edge, permission, change_weight, search.cost, plan)
        row = roads.lanes[lane]
        for k in range(row["first_into"], row["first_into"] + row["num_into"]):
            before = roads.into[k]
            other = roads.lanes[before]
            if other["permissions"] & permission and _leads_to(roads, before, lane):
                size = _offer(search, before, here + other["length_m"] / other["speed_mps"], size)
        for side in (1, -1):
            beside = row["left"] if side > 0 else row["right"]
            if (
                beside >= 0
                and roads.lanes[beside]["permissions"] & permission
                and not is_barred(roads, beside, -side, permission)
            ):
                reached = here + change_cost(roads, beside, change_weight)
                size = _offer(search, beside, reached, size)


def plan_goal(
    roads: RoadArrays, goal_edge: int, permission: int, change_weight: float, plan: NDArray[np.void]
) -> None:
    """Fill the plan of one goal.

    Args:
        roads: the road arrays.
        goal_edge: EDGE row to reach.
        change_weight: factor on the cost of lane changes. If it is large, plans change lanes only
            where the goal cannot be reached otherwise.
        permission: bit of LANE["permissions"] that a lane needs.
        plan: PLAN records (L,), overwritten. Lanes from which the goal cannot be reached get
            to_go = inf and next = -1.
    """
    num_lanes = roads.lanes.shape[0]
    search = _Search(
        cost=np.full(num_lanes, math.inf),
        heap=np.zeros(num_lanes, dtype=np.int32),
        place=np.full(num_lanes, _UNSEEN, dtype=np.int32),
    )
    _search_plan(roads, goal_edge, permission, change_weight, plan, search)
