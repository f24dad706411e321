"""The default duration of an episode: long enough for trips across the map."""

from __future__ import annotations

import numpy as np

from cavmarl.roads.network import CARS, RoadNetwork

CROSSINGS = 3.0  # factor on the time of a drive across the empty map; traffic is slower
LEAST_S, MOST_S, ROUND_S = 60.0, 900.0, 10.0


def horizon_of(network: RoadNetwork) -> float:
    """Return `CROSSINGS` times the duration in s of a drive over the map's width plus its height.

    The assumed speed is the mean speed of a car that drives every lane once at the speed limit. The
    result is rounded to tens and limited to [60, 900]. Of several maps, the longest result counts.
    """
    return max(_horizon_on(network, number) for number in range(len(network.maps)))


def _horizon_on(network: RoadNetwork, number: int) -> float:
    min_x, min_y, max_x, max_y = network.extent_of(number)
    lanes = network.lanes[network.lanes["map"] == number]
    lanes = lanes[(lanes["permissions"] & CARS != 0) & ~lanes["internal"]]
    if not len(lanes):
        return LEAST_S
    s_per_m = float(np.sum(lanes["length_m"] / lanes["speed_mps"]) / np.sum(lanes["length_m"]))
    crossing_s = (max_x - min_x + max_y - min_y) * s_per_m
    whole_s = ROUND_S * round(CROSSINGS * crossing_s / ROUND_S)
    return min(max(whole_s, LEAST_S), MOST_S)
