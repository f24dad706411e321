"""How long an episode lasts that no configuration bounds: long enough for trips over the map."""

from __future__ import annotations

import numpy as np

from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork

CROSSINGS = 3.0  # times the free-flow time of a trip across the map: others are in the way
LEAST_S, MOST_S, ROUND_S = 60.0, 900.0, 10.0
_CAR = 1 << VEHICLE_CLASSES.index("passenger")


def horizon_of(network: RoadNetwork) -> float:
    """Seconds for three trips across a map at its limits: its width and then its height.

    The speed is that of a car that drives over each lane once. Whole tens from 60 to 900. Of
    several maps it is that of the longest.
    """
    return max(_horizon_on(network, number) for number in range(len(network.maps)))


def _horizon_on(network: RoadNetwork, number: int) -> float:
    min_x, min_y, max_x, max_y = network.extent_of(number)
    lanes = network.lanes[network.lanes["map"] == number]
    lanes = lanes[(lanes["permissions"] & _CAR != 0) & ~lanes["internal"]]
    if not len(lanes):
        return LEAST_S
    s_per_m = float(np.sum(lanes["length_m"] / lanes["speed_mps"]) / np.sum(lanes["length_m"]))
    crossing_s = (max_x - min_x + max_y - min_y) * s_per_m
    whole_s = ROUND_S * round(CROSSINGS * crossing_s / ROUND_S)
    return min(max(whole_s, LEAST_S), MOST_S)
