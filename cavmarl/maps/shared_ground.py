"""What a map draws so that its vehicles touch whatever drivers do: rules, by which it is named."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import lane_grid

CAR_LENGTH_M, CAR_WIDTH_M = 5.0, 1.8
LEVEL_M = 3.0  # lanes that differ more in height are a bridge and the road below it
STEP_M = 1.0


def shared_ground(network: RoadNetwork) -> list[tuple[int, int]]:
    """Pairs of LANE rows of two roads that lie nearer to each other than cars are wide.

    Asked is outside junctions, and not where the one road leads into the other.
    """
    grid = lane_grid(network)
    links = network.links[network.links["direction"] != ord("t")]
    pairs = zip(links["from_lane"].tolist(), links["to_lane"].tolist(), strict=True)
    asked = {(min(pair), max(pair)) for pair in pairs}
    places = {
        int(lane): _places(network, int(lane))
        for lane in np.flatnonzero(~network.lanes["internal"])
    }
    found = []
    for first, end in zip(grid.cell_start[:-1], grid.cell_start[1:], strict=True):
        here = [int(lane) for lane in grid.cell_lanes[first:end] if int(lane) in places]
        for n, one in enumerate(here):
            for other in here[n + 1 :]:
                pair = (min(one, other), max(one, other))
                if pair in asked:
                    continue
                asked.add(pair)
                roads = network.lanes["edge"][list(pair)]
                if roads[0] != roads[1] and _touch(places[one], places[other]):
                    found.append(pair)
    return sorted(found)


def stub_lanes(network: RoadNetwork) -> NDArray[np.int64]:
    """LANE rows of roads of several lanes that are shorter than a car: too short for changes."""
    edges = network.edges[network.lanes["edge"]]
    stubs = ~network.lanes["internal"] & (edges["num_lanes"] > 1)
    return np.flatnonzero(stubs & (network.lanes["length_m"] < CAR_LENGTH_M))


def _touch(mine: NDArray[np.float64], theirs: NDArray[np.float64]) -> bool:
    apart = mine[:, None] - theirs[None]
    square = apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]
    level = np.abs(apart[..., 2]) < LEVEL_M
    return bool((level & (square < CAR_WIDTH_M * CAR_WIDTH_M)).any())


def _places(network: RoadNetwork, lane: int) -> NDArray[np.float64]:
    points = network.lane_points(lane)
    at = np.linspace(0.0, points["s"][-1], int(points["s"][-1] / STEP_M) + 2)
    return np.stack([np.interp(at, points["s"], points[axis]) for axis in "xyz"], axis=1)
