"""The positions of a map's signals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork


def links_of_signal(network: RoadNetwork, signal: int) -> NDArray[np.intp]:
    """Return the LINK rows (n,) that a signal controls."""
    return np.flatnonzero(network.links["signal"] == signal)


def stop_lines(network: RoadNetwork, signal: int) -> NDArray[np.void]:
    """Return POINT (n,): the end of the lane before each link of a signal."""
    lanes = network.lanes[network.links["from_lane"][links_of_signal(network, signal)]]
    ends: NDArray[np.void] = network.points[lanes["first_point"] + lanes["num_points"] - 1]
    return ends


def place_of_signal(network: RoadNetwork, signal: int) -> tuple[float, float, float]:
    """Return x, y, z of the centre of a signal's stop lines in m; zeros if it has no links."""
    ends = stop_lines(network, signal)
    if not len(ends):
        return 0.0, 0.0, 0.0
    return float(ends["x"].mean()), float(ends["y"].mean()), float(ends["z"].mean())
