"""Search for zones without loops: no vehicle can stay in such a zone forever while it drives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.maps.components import strong_components
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_partition import ZonePartition


def zones_without_loop(network: RoadNetwork, partition: ZonePartition) -> tuple[int, ...]:
    """Return the zones without a closed route whose edges and junctions are all inside."""
    lanes, links = network.lanes, network.links
    places = np.stack([network.points["x"], network.points["y"]], axis=1)
    zones = partition.zones_of(places)
    first, last = (
        _of_links(network, ufunc, ufunc.reduceat(zones, lanes["first_point"]))
        for ufunc in (np.minimum, np.maximum)
    )
    whole = first == last
    of_lane = lanes["edge"]
    arcs = np.stack([of_lane[links["from_lane"]], of_lane[links["to_lane"]]], axis=1)[whole]
    component = strong_components(len(network.edges), arcs)
    # An arc between two edges is part of a closed route if the edges can reach each other.
    closed = component[arcs[:, 0]] == component[arcs[:, 1]]
    with_loop = set(first[whole][closed].tolist())
    return tuple(zone for zone in range(partition.count) if zone not in with_loop)


def _of_links(
    network: RoadNetwork, ufunc: np.ufunc, of_lanes: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return the lowest or highest zone number on each link and the edges before and after it."""
    lanes, links = network.lanes, network.links
    of_edges = ufunc.reduceat(of_lanes, network.edges["first_lane"])
    from_edge, to_edge = (lanes["edge"][links[end]] for end in ("from_lane", "to_lane"))
    found: NDArray[np.int32] = ufunc(of_edges[from_edge], of_edges[to_edge])
    inside = np.flatnonzero(lanes["internal"])
    ufunc.at(found, lanes["link"][inside], of_lanes[inside])
    return found
