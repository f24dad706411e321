"""Junctions where ways give way to each other in a circle: vehicles there wait for each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

SIGNED = [ord(state) for state in "Mms"]  # states of links: major, minor, behind a stop sign


def circular_priority(network: RoadNetwork) -> NDArray[np.int64]:
    """LINK rows that give way in a circle of three or more, or that lie between two such circles.

    Asked is at junctions where signs tell which road comes first. Among equals, at all-way stops
    and at signals, drivers settle it another way.
    """
    links = network.links
    first, count = links["first_conflict"].astype(np.int64), links["num_conflicts"].astype(np.int64)
    owner = np.repeat(np.arange(len(links)), count)
    rows = np.arange(len(owner)) + np.repeat(first - np.cumsum(count) + count, count)
    foe, yields = network.conflicts["foe"][rows], network.conflicts["must_yield"][rows]
    signed = (links["signal"] < 0) & np.isin(links["state"], SIGNED)
    asked = yields & signed[owner] & signed[foe]
    edges = np.unique(np.stack([owner[asked], foe[asked]], axis=1), axis=0)
    pairs = set(map(tuple, edges.tolist()))
    one_way = np.array([(b, a) not in pairs for a, b in edges.tolist()], dtype=bool)
    edges = edges[one_way]
    while True:
        left = np.intersect1d(edges[:, 0], edges[:, 1])  # it gives way, and others to it
        inside = np.isin(edges, left).all(axis=1)
        if inside.all():
            return left
        edges = edges[inside]
