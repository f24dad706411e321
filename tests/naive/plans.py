"""Compute least travel times over the lane graph by iterating the definition to a fixed point."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

LANE_CHANGE_COST_S = 5.0
LANE_CHANGE_M = 250.0


def followers(roads: RoadNetwork, lane: int) -> list[tuple[int, int]]:
    """Return (next lane, link or -1) of each movement at the end of a lane.

    U-turns count only if no lane of the road has another movement.
    """
    row = roads.lanes[lane]
    if row["internal"]:
        return [(int(row["successor"]), -1)]
    edge = roads.edges[row["edge"]]
    beside = range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"])
    dead_end = all(_turns_round(roads, link) for other in beside for link in _links(roads, other))
    return [
        (int(roads.links[link]["next_lane"]), link)
        for link in _links(roads, lane)
        if dead_end or not _turns_round(roads, link)
    ]


def _links(roads: RoadNetwork, lane: int) -> range:
    row = roads.lanes[lane]
    return range(int(row["first_link"]), int(row["first_link"] + row["num_links"]))


def _turns_round(roads: RoadNetwork, link: int) -> bool:
    return chr(roads.links[link]["direction"]) == "t"


def neighbours(roads: RoadNetwork, lane: int, permission: int) -> list[int]:
    """Return the adjacent lanes to which a vehicle may change; inside junctions there are none."""
    row = roads.lanes[lane]
    if row["internal"]:
        return []
    beside = [int(row["left"]), int(row["right"])]
    return [b for b in beside if b >= 0 and roads.lanes[b]["permissions"] & permission]


def change_cost(roads: RoadNetwork, lane: int) -> float:
    """Return the cost of leaving a lane sideways, in s."""
    return LANE_CHANGE_COST_S * (1.0 + LANE_CHANGE_M / float(roads.lanes[lane]["length_m"]))


def costs(roads: RoadNetwork, goal_edge: int, permission: int) -> NDArray[np.float64]:
    """Return the travel time in s from the start of each lane to the end of the goal, or inf."""
    drive = roads.lanes["length_m"] / roads.lanes["speed_mps"]
    allowed = roads.lanes["permissions"] & permission != 0
    cost = np.full(len(roads.lanes), math.inf)
    while True:
        before = cost.copy()
        for lane in np.flatnonzero(allowed).tolist():
            if roads.lanes[lane]["edge"] == goal_edge:
                cost[lane] = drive[lane]
                continue
            through = [drive[lane] + before[n] for n, _ in followers(roads, lane) if allowed[n]]
            sideways = [
                change_cost(roads, lane) + before[beside]
                for beside in neighbours(roads, lane, permission)
            ]
            cost[lane] = min([*through, *sideways, before[lane]])
        if np.array_equal(cost, before):
            return cost
