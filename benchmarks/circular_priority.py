"""Junctions where signs have links give way in a circle: vehicles there wait for each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

SIGNED = [ord(state) for state in "Mms"]  # states of links: major, minor, behind a stop sign


def circular_priority(network: RoadNetwork) -> NDArray[np.int64]:
    """LINK rows that give way in a circle, or that lie between two circles.

    Only junctions count where signs say which road comes first: among equals, at all-way stops and
    at signals drivers settle it another way.
    """
    links = network.links
    owner = np.repeat(np.arange(len(links)), links["num_conflicts"])
    foe = network.conflicts["foe"]
    signed = (links["signal"] < 0) & np.isin(links["state"], SIGNED)
    asked = network.conflicts["must_yield"] & signed[owner] & signed[foe]
    edges = np.stack([owner[asked], foe[asked]], axis=1)
    while True:
        left = np.intersect1d(edges[:, 0], edges[:, 1])  # it gives way, and others to it
        inside = np.isin(edges, left).all(axis=1)
        if inside.all():
            return left
        edges = edges[inside]
