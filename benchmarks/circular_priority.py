"""Junctions whose signs make links yield in a circle, so that vehicles wait for each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

SIGNED = [ord(state) for state in "Mms"]  # link states: major, minor, stop sign


def circular_priority(network: RoadNetwork) -> NDArray[np.int64]:
    """Return the LINK rows that yield in a circle, or lie between two such circles.

    Only junctions with priority signs count: at uncontrolled junctions, all-way stops and signals,
    drivers resolve the conflict in other ways.
    """
    links = network.links
    owner = np.repeat(np.arange(len(links)), links["num_conflicts"])
    foe = network.conflicts["foe"]
    signed = (links["signal"] < 0) & np.isin(links["state"], SIGNED)
    asked = network.conflicts["must_yield"] & signed[owner] & signed[foe]
    edges = np.stack([owner[asked], foe[asked]], axis=1)
    while True:
        left = np.intersect1d(edges[:, 0], edges[:, 1])  # links that yield and that are yielded to
        inside = np.isin(edges, left).all(axis=1)
        if inside.all():
            return left
        edges = edges[inside]
