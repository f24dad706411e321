"""Outlines of a map's roads, small enough to store with results."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork

PASSENGER = 1 << VEHICLE_CLASSES.index("passenger")
TOLERANCE_M = 0.5  # that a line may leave the lane's centre by


def map_outline(network: RoadNetwork) -> dict[str, Any]:
    """Centre lines of the lanes open to cars, in metres to a decimetre, and their mean width."""
    lanes = network.lanes
    open_lanes = np.flatnonzero(lanes["permissions"] & PASSENGER != 0)
    lines = [_simplified(network.lane_polyline(int(lane))[:, :2]) for lane in open_lanes]
    return {
        "name": network.name,
        "extent_m": list(network.extent_m),
        "lane_width_m": float(lanes["width_m"][open_lanes].mean()),
        "lines": [np.round(line, 1).tolist() for line in lines],
    }


def _simplified(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """A polyline (n, 2) without the points that it can do without (Douglas and Peucker 1973)."""
    keep = np.zeros(len(line), dtype=np.bool_)
    keep[[0, -1]] = True
    stretches = [(0, len(line) - 1)]
    while stretches:
        first, last = stretches.pop()
        if last - first < 2:
            continue
        chord = line[last] - line[first]
        inner = line[first + 1 : last] - line[first]
        length = float(np.hypot(*chord))
        off = (
            np.abs(inner[:, 0] * chord[1] - inner[:, 1] * chord[0]) / length
            if length > 0.0
            else np.hypot(*inner.T)
        )
        worst = int(off.argmax())
        if off[worst] > TOLERANCE_M:
            middle = first + 1 + worst
            keep[middle] = True
            stretches += [(first, middle), (middle, last)]
    return line[keep]
