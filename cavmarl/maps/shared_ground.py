"""Lanes of different roads that a map draws over each other at the same height.

Vehicles touch there although their drivers obey all rules. An example is a tunnel in a map without
heights.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.roads.routing import lane_grid

CAR_WIDTH_M = 1.8
LEVEL_M = 3.0  # lanes with a larger difference in height are a bridge and the road below it
STEP_M = 1.0  # distance between the compared places of a lane


def shared_ground(network: RoadNetwork) -> list[tuple[int, int]]:
    """Return pairs of LANE rows that are closer than a car's width and have no right of way.

    The lanes of a pair belong to two roads, without a link between the lanes; or to two junctions
    that do not lead to each other; or to a road and a junction that are not connected.
    """
    grid = lane_grid(network)
    links = network.links[network.links["direction"] != ord("t")]
    pairs = zip(links["from_lane"].tolist(), links["to_lane"].tolist(), strict=True)
    asked = {(min(pair), max(pair)) for pair in pairs}
    places = [_places(network, lane) for lane in range(len(network.lanes))]
    owners = _owners(network)
    found = []
    for first, end in zip(grid.cell_start[:-1], grid.cell_start[1:], strict=True):
        here = [int(lane) for lane in grid.cell_lanes[first:end]]
        for n, one in enumerate(here):
            for other in here[n + 1 :]:
                pair = (min(one, other), max(one, other))
                if pair in asked:
                    continue
                asked.add(pair)
                if _are_apart(owners, *pair) and _touch(places[one], places[other]):
                    found.append(pair)
    return sorted(found)


def touching_roads(network: RoadNetwork) -> list[tuple[int, int]]:
    """Return the first pair of `shared_ground` open to cars for each two roads or junctions."""
    cars = network.lanes["permissions"] & CARS != 0
    owners = _owners(network)
    found: dict[Any, tuple[int, int]] = {}
    for pair in shared_ground(network):
        if cars[list(pair)].all():
            found.setdefault(tuple((owners.inside[k], owners.ground[k]) for k in pair), pair)
    return list(found.values())


class _Owners(NamedTuple):
    """The road or junction of each lane, and the road or junction before and after it."""

    inside: list[bool]  # whether the lane is in a junction
    ground: list[int]  # EDGE or JUNCTION row
    before: list[int]  # JUNCTION row before a road, EDGE row before a lane in a junction
    beyond: list[int]


def _owners(network: RoadNetwork) -> _Owners:
    inside, edge = network.lanes["internal"], network.lanes["edge"]
    links = network.links if len(network.links) else np.zeros(1, network.links.dtype)
    link = links[np.where(inside, network.lanes["link"], 0)]
    road = network.edges[edge]
    return _Owners(
        inside.tolist(),
        np.where(inside, link["junction"], edge).tolist(),
        np.where(inside, edge[link["from_lane"]], road["from_junction"]).tolist(),
        np.where(inside, edge[link["to_lane"]], road["to_junction"]).tolist(),
    )


def _are_apart(owners: _Owners, one: int, other: int) -> bool:
    """Return whether two lanes belong to different roads, or to places that are not connected."""
    inside, ground, before, beyond = owners
    if inside[one] != inside[other]:
        road, junction = (other, one) if inside[one] else (one, other)
        return ground[junction] not in (before[road], beyond[road])
    if ground[one] == ground[other]:
        return False
    if not inside[one]:
        return True
    return beyond[one] != before[other] and beyond[other] != before[one]


def _touch(mine: NDArray[np.float64], theirs: NDArray[np.float64]) -> bool:
    apart = mine[:, None] - theirs[None]
    square = apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1]
    level = np.abs(apart[..., 2]) < LEVEL_M
    return bool((level & (square < CAR_WIDTH_M * CAR_WIDTH_M)).any())


def _places(network: RoadNetwork, lane: int) -> NDArray[np.float64]:
    points = network.lane_points(lane)
    at = np.linspace(0.0, points["s"][-1], int(points["s"][-1] / STEP_M) + 2)
    return np.stack([np.interp(at, points["s"], points[axis]) for axis in "xyz"], axis=1)
