"""Compares a map with its OpenDRIVE file and with the network that netconvert reads from it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from cavmarl.maps.exports.opendrive_lanes import LANES
from cavmarl.roads.network import CARS, RoadNetwork

MOST_OFF = 0.02  # maximum relative error of the total length


@dataclass(frozen=True)
class CarRoads:
    """Roads that cars may use; netconvert does not export some other roads."""

    edges: int
    lanes: int
    links: int  # movements over junctions
    road_m: float
    merges: int = 0  # links into a lane that another lane of the same road also enters


@dataclass(frozen=True)
class RoundTrip:
    """A map, the file written from it, and that file as read by netconvert.

    If several lanes of a road enter the same lane of the next road, netconvert reads only one of
    these links. It also shortens roads at junctions.
    """

    map: CarRoads
    file: CarRoads
    read: CarRoads
    problems: tuple[str, ...] = field(init=False)  # empty if topology and lengths are the same

    def __post_init__(self) -> None:
        object.__setattr__(self, "problems", tuple(self._found()))

    def _found(self) -> list[str]:
        found = [
            f"{name} {count} in the map, {written} in the file"
            for name in ("edges", "lanes", "links")
            if (count := getattr(self.map, name)) != (written := getattr(self.file, name))
        ]
        found += [
            f"{name} {count} in the map, {read} read by netconvert"
            for name in ("edges", "lanes")
            if (count := getattr(self.map, name)) != (read := getattr(self.read, name))
        ]
        fewest = self.map.links - self.map.merges
        if not fewest <= self.read.links <= self.map.links:
            found.append(f"links {self.map.links} in the map, {self.read.links} read by netconvert")
        if self.off > MOST_OFF:
            found.append(f"total length of roads: the file differs from the map by {self.off:.1%}")
        return found

    @property
    def off(self) -> float:
        """Relative error of the total length of the roads in the file."""
        return _off(self.map, self.file)

    @property
    def read_off(self) -> float:
        """Relative error of the total length of the roads that netconvert reads."""
        return _off(self.map, self.read)

    @property
    def same(self) -> bool:
        return not self.problems

    def to_dict(self) -> dict[str, Any]:
        derived = {"off": self.off, "read_off": self.read_off, "same": self.same}
        return asdict(self) | derived


def _off(one: CarRoads, other: CarRoads) -> float:
    return abs(other.road_m / max(one.road_m, 1e-9) - 1.0)


def roads_of_map(network: RoadNetwork) -> CarRoads:
    """Return the roads of a SUMO network."""
    lanes, links = network.lanes, network.links
    cars = (lanes["permissions"] & CARS != 0) & ~lanes["internal"]
    edges = np.unique(lanes["edge"][cars])
    outside = links[~lanes["internal"][links["from_lane"]] & ~lanes["internal"][links["to_lane"]]]
    pairs = np.stack([lanes["edge"][outside["from_lane"]], outside["to_lane"]], axis=1)
    return CarRoads(
        edges=len(edges),
        lanes=int(cars.sum()),
        links=int((cars[links["from_lane"]] & cars[links["to_lane"]]).sum()),
        road_m=float(network.edges["length_m"][edges].sum()),
        merges=len(pairs) - len(np.unique(pairs, axis=0)),
    )


def roads_of_file(root: Element) -> CarRoads:
    """Return the roads of netconvert's OpenDRIVE: lanes on the right, in one section."""
    roads = {road.get("id", ""): road for road in root.iter("road")}
    driven = {
        (number, lane.get("id", ""))
        for number, road in roads.items()
        for lane in road.iterfind(LANES)
        if lane.get("type") == "driving"
    }
    outside = {number for number, road in roads.items() if road.get("junction", "-1") == "-1"}
    on_roads = {place for place in driven if place[0] in outside}
    edges = {number for number, _ in on_roads}
    movements = _movements(root, roads)
    return CarRoads(
        edges=len(edges),
        lanes=len(on_roads),
        links=sum(one in on_roads and other in on_roads for one, other in movements),
        road_m=sum(float(roads[number].get("length", "0")) for number in edges),
    )


def _movements(root: Element, roads: dict[str, Element]) -> set[tuple[Any, Any]]:
    """Return pairs of lanes, each as (road, number), that are connected over junctions."""
    found = set()
    for connection in root.iterfind("junction/connection"):
        over = roads[connection.get("connectingRoad", "")]
        after = over.find("link/successor")
        ends = {lane.get("id"): lane.find("link/successor") for lane in over.iterfind(LANES)}
        for link in connection.iterfind("laneLink"):
            end = ends.get(link.get("to"))
            if after is not None and end is not None:
                start = (connection.get("incomingRoad"), link.get("from"))
                found.add((start, (after.get("elementId"), end.get("id"))))
    return found
