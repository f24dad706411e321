"""Data of OpenStreetMap that netconvert does not use: levels, names, missing tags."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.handler import ContentHandler

from cavmarl.core.errors import MapError
from cavmarl.roads.sumo_net.xml_source import read_xml

_TAGS = frozenset(
    ("highway", "bridge", "tunnel", "layer", "name", "ref", "lanes", "maxspeed", "width")
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
