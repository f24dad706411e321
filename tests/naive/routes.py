"""Compute shortest paths along a sequence of edges by iterating the definition to a fixed point."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cavmarl.roads.network import RoadNetwork
from tests.naive.plans import change_cost


def lanes_of(roads: RoadNetwork, edge: int) -> range:
    """Return the lanes of an edge, from right to left."""
    row = roads.edges[edge]
    return range(int(row["first_lane"]), int(row["first_lane"] + row["num_lanes"]))


def costs(
    roads: RoadNetwork, edges: Sequence[int], permission: int
) -> dict[tuple[int, int], float]:
    """Return travel times in s by (index in the route, lane) with lane changes, or inf."""
    allowed = roads.lanes["permissions"] & permission != 0
    cost = {(n, lane): math.inf for n, edge in enumerate(edges) for lane in lanes_of(roads, edge)}
    while True:
        before = dict(cost)
        for n, lane in cost:
            if not allowed[lane]:
                continue
            row = roads.lanes[lane]
            drive = float(row["length_m"] / row["speed_mps"])
            options = [before[n, lane]]
            if n == len(edges) - 1:
                options.append(drive)
            for link in range(int(row["first_link"]), int(row["first_link"] + row["num_links"])):
                options.append(
                    drive + before.get((n + 1, int(roads.links[link]["to_lane"])), math.inf)
                )
            for beside in (int(row["left"]), int(row["right"])):
                options.append(change_cost(roads, lane) + before.get((n, beside), math.inf))
            cost[n, lane] = min(options)
        if cost == before:
            return cost


def length(roads: RoadNetwork, lane: int, link: int) -> float:
    """Return the length of a lane and of the link at its end, in m."""
    return float(roads.lanes[lane]["length_m"] + roads.links[link]["length_m"])
