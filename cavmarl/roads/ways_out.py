"""Roads from which no route leads out of the map, because other roads are closed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import CARS, RoadNetwork


def shut_in_roads(network: RoadNetwork, closed: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Return which roads (num_edges,) are open to cars but have no way out.

    A way out is a road that leads out of the map. If the map has no such road, each road with an
    endless route counts as a way out.

    Args:
        network: the map.
        closed: (L,) bits of the classes to which each lane is closed.
    """
    lanes, links, num = network.lanes, network.links, len(network.edges)
    on_map = (lanes["permissions"] & CARS) != 0
    is_open = on_map & ((closed & CARS) == 0)
    source, target = links["from_lane"], links["to_lane"]
    for_cars = on_map[source] & on_map[target]
    edges = lanes["edge"]
    leads_on = np.zeros(num, dtype=np.bool_)
    leads_on[edges[source[for_cars]]] = True
    has_open = np.zeros(num, dtype=np.bool_)
    has_open[edges[is_open & ~lanes["internal"]]] = True
    passable = is_open[source] & is_open[target]
    before, after = edges[source[passable]], edges[target[passable]]
    exits = has_open & ~leads_on
    on_map_exits = np.zeros(num, dtype=np.bool_)
    on_map_exits[edges[on_map & ~lanes["internal"]]] = True
    if (on_map_exits & ~leads_on).any():
        return has_open & ~_spread(exits, before, after)
    return has_open & ~_lasting(has_open, before, after)


def _spread(
    exits: NDArray[np.bool_], before: NDArray[np.int32], after: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return from which roads an exit can be reached."""
    found = exits.copy()
    while True:
        new = found[after] & ~found[before]
        if not new.any():
            return found
        found[before[new]] = True


def _lasting(
    has_open: NDArray[np.bool_], before: NDArray[np.int32], after: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return from which roads some route never ends."""
    found = has_open.copy()
    while True:
        goes_on = np.zeros_like(found)
        goes_on[before[found[after]]] = True
        if not (found & ~goes_on).any():
            return found
        found &= goes_on
