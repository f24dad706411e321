"""A plain version of `cavmarl.roads.routing.lane_grid` that adds lanes to cells in pieces."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from cavmarl.roads.network import RoadNetwork

__all__ = ["cells_of_lanes"]


def cells_of_lanes(
    network: RoadNetwork, origin: tuple[float, float], shape: tuple[int, int], cell_m: float
) -> list[list[int]]:
    """Return the LANE rows of each cell, in order.

    Args:
        network: the map.
        origin: x and y of the corner of the first cell in m.
        shape: numbers of cells along x and along y.
        cell_m: side of a cell in m.
    """
    members: list[set[int]] = [set() for _ in range(shape[0] * shape[1])]
    for lane, row in enumerate(network.lanes):
        reach = 0.5 * float(row["width_m"]) + 2.0
        for (x0, y0, _), (x1, y1, _) in pairwise(network.lane_polyline(lane)):
            pieces = int(np.hypot(x1 - x0, y1 - y0) // cell_m) + 1
            xs, ys = np.linspace(x0, x1, pieces + 1), np.linspace(y0, y1, pieces + 1)
            for k in range(pieces):
                left = int((min(xs[k], xs[k + 1]) - reach - origin[0]) // cell_m)
                right = int((max(xs[k], xs[k + 1]) + reach - origin[0]) // cell_m)
                low = int((min(ys[k], ys[k + 1]) - reach - origin[1]) // cell_m)
                high = int((max(ys[k], ys[k + 1]) + reach - origin[1]) // cell_m)
                for j in range(max(low, 0), min(high, shape[1] - 1) + 1):
                    for i in range(max(left, 0), min(right, shape[0] - 1) + 1):
                        members[j * shape[0] + i].add(lane)
    return [sorted(cell) for cell in members]
