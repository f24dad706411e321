"""Compute mean speeds of edges from their definition, edge by edge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork


def millimetres(speed: float) -> int:
    """Round a non-negative speed in m/s to whole mm/s, halves up."""
    return int(np.floor(max(speed, 0.0) * 1000.0 + 0.5))


def mean_speeds(roads: RoadNetwork, rows: NDArray[np.void]) -> list[int]:
    """Return the mean speed per edge in mm/s; an empty lane counts as a vehicle at the limit."""
    means = []
    for edge in roads.edges:
        speeds = []
        for lane in range(int(edge["first_lane"]), int(edge["first_lane"] + edge["num_lanes"])):
            driving = [row for row in rows if row["lane"] == lane and row["stopped_s"] == 0.0]
            speeds += [millimetres(float(row["speed"])) for row in driving]
            if not driving:
                speeds.append(millimetres(float(roads.lanes[lane]["speed_mps"])))
        means.append(sum(speeds) // len(speeds))
    return means
