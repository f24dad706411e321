"""Properties of maps by which worlds are grouped."""

from __future__ import annotations

from benchmarks.circular_priority import circular_priority
from benchmarks.shared_ground import shared_ground, stub_lanes
from cavmarl.roads.network import RoadNetwork

MAP_FEATURES = frozenset(("circular_priority", "shared_ground", "stub_lanes"))


def map_features(network: RoadNetwork) -> tuple[str, ...]:
    """Return the names of the properties that a network has."""
    found = {
        "circular_priority": circular_priority(network).size,
        "shared_ground": shared_ground(network),
        "stub_lanes": stub_lanes(network).size,
    }
    return tuple(name for name, holds in found.items() if holds)
