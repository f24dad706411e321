"""Explicit routes: the next step from every lane of the edges of a route."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.roads.kernels.plans import change_cost, is_barred


@kernel
def plan_route(
    roads: RoadArrays,
    edges: NDArray[np.int32],
    permission: int,
    first_step: int,
    steps: NDArray[np.void],
    cost: NDArray[np.float64],
) -> int:
    """Fill the steps of one route, edge after edge.

    The steps of an edge's lanes are contiguous. A vehicle's "way" on the edge is the index of the
    first step minus the edge's first lane. Costs are computed as in `kernels.plans`, but only along
    the route.

    Args:
        roads: the road arrays.
        edges: (n,) EDGE rows, each connected to the previous one.
        permission: bits of LANE["permissions"]; a lane needs one of them.
        first_step: index in `steps` at which the route begins.
        steps: PLAN, overwritten from `first_step` on. Lanes from which the route cannot be
            followed get to_go = inf.
        cost: scratch memory, as long as `steps`.

    Returns:
        The number of steps.
    """
    end = first_step
    for n in range(edges.shape[0]):
        end += roads.edges[edges[n]]["num_lanes"]
    begin = end
    way_after = 0
    for n in range(edges.shape[0] - 1, -1, -1):
        edge = roads.edges[edges[n]]
        first = edge["first_lane"]
        begin -= edge["num_lanes"]
        way = begin - first
        last = n == edges.shape[0] - 1
        for lane in range(first, first + edge["num_lanes"]):
            _begin_step(steps[way + lane])
            cost[way + lane] = math.inf
            if not roads.lanes[lane]["permissions"] & permission:
                continue
            if last:
                steps[way + lane]["to_go"] = roads.lanes[lane]["length_m"]
                steps[way + lane]["room"] = roads.lanes[lane]["length_m"]
                cost[way + lane] = roads.lanes[lane]["length_m"] / roads.lanes[lane]["speed_mps"]
            else:
                _go_through(roads, lane, way, edges[n + 1], way_after, steps, cost)
        # Propagate lane changes over the lanes of an edge, from the kerb inwards and back.
        for lane in range(first + 1, first + edge["num_lanes"]):
            _go_sideways(roads, lane, lane - 1, permission, way, steps, cost)
        for lane in range(first + edge["num_lanes"] - 2, first - 1, -1):
            _go_sideways(roads, lane, lane + 1, permission, way, steps, cost)
        way_after = way
    return end - first_step


@kernel
def _begin_step(step: np.void) -> None:
    step["next"] = -1
    step["link"] = -1
    step["shift"] = 0
    step["change"] = 0
    step["changes"] = 0
    step["turnarounds"] = 0
    step["room"] = 0.0
    step["to_go"] = math.inf


@kernel
def _go_through(
    roads: RoadArrays,
    lane: int,
    way: int,
    edge_after: int,
    way_after: int,
    steps: NDArray[np.void],
    cost: NDArray[np.float64],
) -> None:
    """Write the step over the cheapest link from a lane to the route's next edge, if any."""
    row = roads.lanes[lane]
    for link in range(row["first_link"], row["first_link"] + row["num_links"]):
        target = roads.links[link]
        to_lane = target["to_lane"]
        if roads.lanes[to_lane]["edge"] != edge_after:
            continue
        reached = row["length_m"] / row["speed_mps"] + cost[way_after + to_lane]
        if reached < cost[way + lane]:
            step = steps[way + lane]
            beyond = steps[way_after + to_lane]
            cost[way + lane] = reached
            step["next"] = target["next_lane"]
            step["link"] = link
            step["shift"] = way_after - way
            step["room"] = row["length_m"] + target["length_m"] + beyond["room"]
            step["to_go"] = row["length_m"] + target["length_m"] + beyond["to_go"]


@kernel
def _go_sideways(
    roads: RoadArrays,
    lane: int,
    beside: int,
    permission: int,
    way: int,
    steps: NDArray[np.void],
    cost: NDArray[np.float64],
) -> None:
    """Write the step to the adjacent lane if it is cheaper than the present step."""
    row = roads.lanes[lane]
    side = int(row["left"] == beside) - int(row["right"] == beside)
    if side == 0 or not row["permissions"] & permission:
        return
    if is_barred(roads, lane, side, permission):
        return
    reached = cost[way + beside] + change_cost(roads, lane, 1.0)
    if reached < cost[way + lane]:
        step = steps[way + lane]
        better = steps[way + beside]
        cost[way + lane] = reached
        step["next"] = -1
        step["link"] = -1
        step["shift"] = 0
        step["change"] = side
        step["changes"] = better["changes"] + 1
        step["room"] = row["length_m"]
        step["to_go"] = better["to_go"]


@kernel
def trace_edges(
    roads: RoadArrays, plan: NDArray[np.void], first_edge: int, out: NDArray[np.int32]
) -> int:
    """Find the edges along a plan, starting from the fastest lane of an edge.

    `plan`: PLAN (L,) of one goal. `out`: memory for EDGE rows, including the first edge.

    Returns the number of edges; 0 if the goal cannot be reached, -1 if `out` is too short.
    """
    edge = roads.edges[first_edge]
    lane = -1
    for candidate in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
        if plan[candidate]["to_go"] < math.inf:
            if lane < 0 or _is_better(roads, plan, candidate, lane):
                lane = candidate
    if lane < 0:
        return 0
    return follow_plan(roads, plan, lane, out)


@kernel
def follow_plan(
    roads: RoadArrays, plan: NDArray[np.void], lane: int, out: NDArray[np.int32]
) -> int:
    """Find the edges along a plan, starting from a lane.

    `plan`: PLAN (L,) of one goal that can be reached from that lane. `lane`: LANE row outside
    junctions. `out`: memory for EDGE rows, including the row of the lane's edge.

    Returns the number of edges; -1 if `out` is too short.
    """
    out[0] = roads.lanes[lane]["edge"]
    found = 1
    while True:
        step = plan[lane]
        if step["change"] > 0:
            lane = roads.lanes[lane]["left"]
        elif step["change"] < 0:
            lane = roads.lanes[lane]["right"]
        elif step["next"] >= 0:
            lane = step["next"]
            if not roads.lanes[lane]["internal"]:
                if found == out.shape[0]:
                    return -1
                out[found] = roads.lanes[lane]["edge"]
                found += 1
        else:
            return found


@kernel
def _time_of(roads: RoadArrays, plan: NDArray[np.void], lane: int) -> float:
    """Return the time in s from the start of a lane to the end of a plan, without lane changes."""
    total: float = 0.0
    while True:
        step = plan[lane]
        if step["change"] > 0:
            lane = roads.lanes[lane]["left"]
        elif step["change"] < 0:
            lane = roads.lanes[lane]["right"]
        else:
            total += roads.lanes[lane]["length_m"] / roads.lanes[lane]["speed_mps"]
            if step["next"] < 0:
                return total
            lane = step["next"]


@kernel
def _is_better(roads: RoadArrays, plan: NDArray[np.void], lane: int, other: int) -> bool:
    """Return whether a plan is faster from `lane` than from `other`, or needs fewer changes."""
    time_s, other_s = _time_of(roads, plan, lane), _time_of(roads, plan, other)
    if time_s != other_s:
        return time_s < other_s
    fewer: bool = plan[lane]["changes"] < plan[other]["changes"]
    return fewer
