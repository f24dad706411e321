"""Properties of maps by which worlds are grouped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.circular_priority import circular_priority
from cavmarl.maps.shared_ground import shared_ground
from cavmarl.roads.network import RoadNetwork

CAR_LENGTH_M = 5.0
MAP_FEATURES = frozenset(("circular_priority", "shared_ground", "stub_lanes"))


def map_features(network: RoadNetwork) -> tuple[str, ...]:
    """Return the names of the properties that a network has."""
    found = {
        "circular_priority": circular_priority(network).size,
        "shared_ground": shared_ground(network),
        "stub_lanes": stub_lanes(network).size,
    }
    return tuple(name for name, holds in found.items() if holds)


def stub_lanes(network: RoadNetwork) -> NDArray[np.int64]:
    """Return the LANE rows, on roads with several lanes, that are too short for lane changes."""
    edges = network.edges[network.lanes["edge"]]
    stubs = ~network.lanes["internal"] & (edges["num_lanes"] > 1)
    return np.flatnonzero(stubs & (network.lanes["length_m"] < CAR_LENGTH_M))
