"""Compute the position of a vehicle of SUMO from its definition."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cavmarl.roads.network import RoadNetwork


def centre(seen: np.void, length: float) -> tuple[float, float, float]:
    """Return x and y of the centre of the body, and the heading counter-clockwise from east."""
    north, east = math.cos(math.radians(seen["angle"])), math.sin(math.radians(seen["angle"]))
    return (
        float(seen["x"] - 0.5 * length * east),
        float(seen["y"] - 0.5 * length * north),
        math.atan2(north, east),
    )


def place(
    network: RoadNetwork, seen: np.void, length: float, link: int
) -> tuple[int, float, float]:
    """Return the LANE row and s of the centre, found backwards from the front along the lanes."""
    lanes, edges = network.lanes, network.edges
    lane = int(seen["lane"])
    scale = lanes[lane]["length_m"] / edges[lanes[lane]["edge"]]["length_m"]
    s = float(seen["pos"]) * float(scale) - 0.5 * length
    while s < 0.0:
        before = [
            row
            for row in range(len(lanes))
            if leads_to(network, row, lane, link if not lanes[lane]["internal"] else None)
        ]
        if len(before) != 1:
            s = 0.0
            break
        lane = before[0]
        s += float(lanes[lane]["length_m"])
    return lane, s, float(seen["lat"])


def leads_to(network: RoadNetwork, before: int, lane: int, link: int | None) -> bool:
    """Return whether a lane leads into another, inside a junction or by one link."""
    row: Any = network.lanes[before]
    if row["internal"]:
        return bool(row["successor"] == lane and (link is None or row["link"] == link))
    first = int(row["first_link"])
    links = network.links[first : first + int(row["num_links"])]
    return link is None and bool((links["next_lane"] == lane).any())
