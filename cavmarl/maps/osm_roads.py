"""Data of OpenStreetMap that netconvert does not use: levels, names, missing tags."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.handler import ContentHandler

from cavmarl.core.errors import MapError
from cavmarl.roads.sumo_net.xml_source import read_xml

_MOST_KINDS = 5  # kinds listed in an error message
_TAGS = frozenset(
    "highway bridge tunnel covered layer name ref lanes maxspeed width oneway busway motorcar "
    "motor_vehicle motor_vehicle:forward motor_vehicle:backward vehicle turn:lanes "
    "turn:lanes:forward turn:lanes:backward lanes:bus lanes:bus:forward lanes:bus:backward "
    "lanes:psv lanes:psv:forward lanes:psv:backward".split()
)
# Kinds of road that netconvert's type map opens to passenger cars.
_FOR_CARS = frozenset(
    "motorway motorway_link trunk trunk_link primary primary_link secondary secondary_link "
    "tertiary tertiary_link unclassified residential living_street unsurfaced construction".split()
)
_ON_THE_GROUND = frozenset(("no", "building_passage", "covered", "culvert"))


@dataclass
class RoadWay:
    """A way with `highway`."""

    nodes: list[str] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)

    @property
    def level(self) -> int:
        """Level above (bridges) or below (tunnels) the ground; 0: on the ground."""
        for key, sign in (("bridge", 1), ("tunnel", -1)):
            if self.tags.get(key, "no") not in _ON_THE_GROUND:
                try:
                    layer = int(self.tags.get("layer", sign))
                except ValueError:
                    layer = sign
                return layer if layer * sign > 0 else sign
        return 0

    @property
    def is_covered(self) -> bool:
        """Whether the way leads under the ground, or under or through buildings."""
        tags = (self.tags.get("tunnel", "no"), self.tags.get("covered", "no"))
        return self.level < 0 or any(tag != "no" for tag in tags)

    @property
    def for_cars(self) -> bool:
        return self.tags.get("highway") in _FOR_CARS

    @property
    def closed_to_cars(self) -> bool:
        """Whether the most specific tag of access for motor vehicles closes the way."""
        keys = ("motorcar", "motor_vehicle", "vehicle")
        return next((self.tags[key] for key in keys if key in self.tags), "yes") == "no"

    @property
    def name(self) -> str:
        return self.tags.get("name") or self.tags.get("ref") or ""


class OsmRoads(ContentHandler):
    """The roads of an OSM file.

    Attributes:
        ways: each way with `highway`, by id.
        places: longitude and latitude of each node, by id.
    """

    def __init__(self, path: Path) -> None:
        """Read a file; raises MapError if it is broken."""
        super().__init__()
        self.ways: dict[str, RoadWay] = {}
        self.places: dict[str, tuple[float, float]] = {}
        self._way: RoadWay | None = None
        self._id = ""
        self._locator: Any = None
        self._path = path
        read_xml(path, self)

    def refuse_without_roads(self) -> None:
        """Raise MapError if no way is a road for cars."""
        if any(way.for_cars for way in self.ways.values()):
            return
        kinds = Counter(way.tags["highway"] for way in self.ways.values())
        listed = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(_MOST_KINDS))
        found = (
            f"its ways with a highway tag are: {listed}" if kinds else "no way has a highway tag"
        )
        raise MapError(
            f"{self._path}: the extract has no road for cars: {found}; export an area with streets "
            "(highway=residential, tertiary, …), with the ways and their nodes"
        )

    def startElement(self, name: str, attrs: Any) -> None:
        try:
            if name == "node":
                self.places[attrs["id"]] = (float(attrs["lon"]), float(attrs["lat"]))
            elif name == "way":
                self._id, self._way = attrs["id"], RoadWay()
            elif self._way is not None and name == "nd":
                self._way.nodes.append(attrs["ref"])
            elif self._way is not None and name == "tag" and attrs["k"] in _TAGS:
                self._way.tags[attrs["k"]] = attrs["v"]
        except (KeyError, ValueError) as error:
            raise MapError(
                f"{self._path}, line {self._locator.getLineNumber()}: <{name}>: {error}: export "
                "the file again"
            ) from error

    def endElement(self, name: str) -> None:
        if name == "way" and self._way is not None:
            if "highway" in self._way.tags:
                self.ways[self._id] = self._way
            self._way = None
