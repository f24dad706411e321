"""Random demand for a map, as a file of vehicles with explicit routes."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import heappop, heappush
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, RouteError
from cavmarl.maps.components import strong_components
from cavmarl.roads.network import CARS, RoadNetwork

MAX_VEHICLES = 1_000_000
_TURNAROUND = ord("t")


class RandomTrips:
    """Draws routes for cars between random places, each along the shortest path.

    Places are edges, drawn in proportion to the length of their lanes. All places are in the
    largest part of the map in which every edge can be reached from every other without a U-turn.

    `seed`: seed of the draws; equal arguments give equal routes.

    Raises RouteError: the map has no two edges that reach each other.
    """

    def __init__(self, network: RoadNetwork, seed: int) -> None:
        self._network = network
        self._random = np.random.default_rng(seed)
        self._into, self._edges = _largest_part(network)
        lanes = network.lanes
        usable = lanes["permissions"] & CARS != 0
        lane_m = np.bincount(lanes["edge"][usable], lanes["length_m"][usable], len(network.edges))
        weights = lane_m[self._edges]
        self._weights = weights / weights.sum()
        self._next_edges: dict[int, dict[int, int]] = {}

    def route(self, least_m: float) -> list[int]:
        """Return the EDGE rows of a route that is at least `least_m` long."""
        lengths = self._network.edges["length_m"]
        route = [self._draw()]
        driven = float(lengths[route[0]])
        while driven < least_m or len(route) == 1:
            goal = self._draw()
            onward = self._toward(goal)
            while route[-1] != goal:
                route.append(onward[route[-1]])
                driven += float(lengths[route[-1]])
        return route

    def _draw(self) -> int:
        return int(self._random.choice(self._edges, p=self._weights))

    def _toward(self, goal: int) -> dict[int, int]:
        """Map each edge to the next edge of its shortest path to `goal` (Dijkstra from there)."""
        if goal not in self._next_edges:
            lengths = self._network.edges["length_m"]
            onward: dict[int, int] = {}
            settled: set[int] = set()
            front = [(0.0, goal, -1)]
            while front:
                distance, edge, after = heappop(front)
                if edge in settled:
                    continue
                settled.add(edge)
                onward[edge] = after
                for before in self._into[edge]:
                    if before not in settled:
                        heappush(front, (distance + float(lengths[edge]), before, edge))
            self._next_edges[goal] = onward
        return self._next_edges[goal]


def write_random_demand(
    network: RoadNetwork, path: Path, *, vehicles: int, within_s: float, route_m: float, seed: int
) -> None:
    """Write a `.rou.xml` of cars whose departures are evenly spaced in time.

    `within_s`: the period over which departures are spread. `route_m`: minimum length of a route.
    `seed`: equal arguments give equal bytes.

    Raises ConfigError: a number is out of range, or the file cannot be written; RouteError: the map
    has no circuit.
    """
    if not 1 <= vehicles <= MAX_VEHICLES:
        raise ConfigError(f"vehicles = {vehicles}: must be from 1 to {MAX_VEHICLES}")
    for name, value in (("within", within_s), ("route", route_m)):
        if not 0.0 <= value <= 1e6:
            raise ConfigError(f"{name} = {value:g}: must be from 0 to 1000000")
    trips = RandomTrips(network, seed)
    try:
        with path.open("w", encoding="utf-8") as file:
            file.writelines(_lines(network, trips, vehicles, within_s, route_m))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def _lines(
    network: RoadNetwork, trips: RandomTrips, vehicles: int, within_s: float, route_m: float
) -> Iterator[str]:
    yield '<routes>\n    <vType id="car" vClass="passenger"/>\n'
    for number in range(vehicles):
        depart = within_s * number / vehicles
        names = " ".join(network.edge_ids[edge] for edge in trips.route(route_m))
        yield (
            f'    <vehicle id="{number}" type="car" depart="{depart:.2f}" departLane="best" '
            f'departPos="random_free" departSpeed="0"><route edges={quoteattr(names)}/></vehicle>\n'
        )
    yield "</routes>\n"


def _largest_part(network: RoadNetwork) -> tuple[list[list[int]], NDArray[np.int64]]:
    """Return the predecessors of each edge, and the edges of the largest connected part.

    The largest part is the part in which the lanes have the largest total length.
    """
    lanes, links = network.lanes, network.links
    usable = lanes["permissions"] & CARS != 0
    good = (
        usable[links["from_lane"]] & usable[links["to_lane"]] & (links["direction"] != _TURNAROUND)
    )
    ends = np.stack([links["from_lane"][good], links["to_lane"][good]], axis=1)
    arcs = np.unique(lanes["edge"][ends], axis=0)
    part = strong_components(len(network.edges), arcs.astype(np.int32))
    in_part = np.bincount(part[lanes["edge"][usable]], lanes["length_m"][usable])
    sizes = np.bincount(part)[: len(in_part)]
    in_part[sizes < 2] = 0.0
    if not in_part.any():
        raise RouteError(
            f"map '{network.name}': no edge can be reached again without a U-turn, so routes "
            "cannot have the wanted length; write demand with origins and destinations by hand"
        )
    chosen = part == np.argmax(in_part)
    into: list[list[int]] = [[] for _ in range(len(network.edges))]
    for before, after in arcs.tolist():
        if chosen[before] and chosen[after]:
            into[after].append(before)
    return into, np.flatnonzero(chosen)
