"""Buildings on a map: walls that rays hit, and footprints as convex parts.

Buildings are read from OpenStreetMap or SUMO's polygon files.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import compress, pairwise
from pathlib import Path
from typing import Any
from xml.sax.handler import ContentHandler

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.maps.projection import project
from cavmarl.roads.kernels.backdrop_pieces import WALL
from cavmarl.roads.network import GeoReference, RoadNetwork
from cavmarl.roads.sumo_net.reader import source_hash
from cavmarl.roads.sumo_net.xml_source import read_xml

Ring = NDArray[np.float64]

DEFAULT_HEIGHT_M = 8.0  # height of a building if the file does not state it
LEVEL_M = 3.0  # height of a level, if only the number of levels is given

PASSABLE_M = 3.0  # vehicles and rays pass under a building that begins at this height or higher

# Values of building=* for buildings without walls and for buildings under which rays pass.
_NO_WALLS = frozenset(("no", "roof", "carport", "canopy", "demolished", "ruins"))
_METRES = re.compile(r"\s*(-?[0-9]+(?:\.[0-9]+)?)\s*(?:m|metres?)?\s*")
_MOST_HEIGHT_M = 1000.0
_DIGITS = 6  # corners are rounded to µm, so that nearly level sides become level (no huge dx/dy)


@dataclass(frozen=True)
class Footprint:
    """A building."""

    name: str  # element and id in the file
    # (n, 2) corners in m in the map's frame, the first not repeated; the inside is given by the
    # even-odd rule
    rings: tuple[Ring, ...]
    height_m: float  # height above the ground
    layer: float = 0.0  # OSM's vertical order of crossing objects; 0: on the ground


def read_footprints(path: Path, geo: GeoReference | None) -> list[Footprint]:
    """Return the buildings of a file that stand on the ground, in its order.

    Buildings under the ground and buildings that begin at `PASSABLE_M` or higher are left out.

    Args:
        path: OpenStreetMap (<osm>), or a SUMO file with <poly> elements; may be gzipped.
        geo: georeference of the map; None: the map has none.

    Raises:
        MapError: the file is broken or belongs to another map, or its coordinates are geographic
            and the map has no georeference.
        MissingExtraError: coordinates must be projected, and pyproj is not installed.
    """
    reader = _Reader(path, geo)
    read_xml(path, reader)
    if reader.root == "osm":
        return list(_osm_buildings(path, reader, geo))
    if reader.root in ("additional", "polygons", "shapes"):
        found = [
            Footprint(element.name, _rings([ring]), _height_m(element.tags), element.layer)
            for element, ring in reader.polygons
            if element.is_on_the_ground
        ]
        return [footprint for footprint in found if footprint.rings]
    raise MapError(
        f"{path}: <{reader.root}> is not the root of a file of buildings: give an OpenStreetMap "
        "extract (<osm>) or SUMO polygons (<additional>, .poly.xml)"
    )


@dataclass
class _Element:
    """A way or relation of OSM, or a polygon of SUMO, with its tags."""

    name: str
    line: int
    tags: dict[str, str] = field(default_factory=dict)
    nodes: list[str] = field(default_factory=list)
    ways: list[str] = field(default_factory=list)

    @property
    def is_building(self) -> bool:
        return self.tags.get("building", "no") not in _NO_WALLS and self.is_on_the_ground

    @property
    def is_on_the_ground(self) -> bool:
        """Return whether the building is neither underground nor above passing vehicles."""
        if self.tags.get("location") == "underground" or self.layer < 0.0:
            return False
        begins_m = _number(self.tags, "min_height")
        if begins_m is None:
            begins_m = (_number(self.tags, "building:min_level") or 0.0) * LEVEL_M
        return begins_m < PASSABLE_M

    @property
    def layer(self) -> float:
        return _number(self.tags, "layer") or 0.0


class _Reader(ContentHandler):
    """Reads nodes, ways and multipolygons of OSM, and polygons of SUMO."""

    def __init__(self, path: Path, geo: GeoReference | None) -> None:
        super().__init__()
        self.root = ""
        self.places: dict[str, tuple[float, float]] = {}
        self.ways: dict[str, _Element] = {}
        self.relations: list[_Element] = []
        self.polygons: list[tuple[_Element, Ring]] = []
        self._open: _Element | None = None
        self._path = path
        self._geo = geo
        self._locator: Any = None

    def startElement(self, name: str, attrs: Any) -> None:
        self.root = self.root or name
        try:
            self._add(name, attrs)
        except KeyError as error:
            raise self._error(name, f"has no attribute {error}") from error
        except ValueError as error:
            raise self._error(name, f"has a value that is not a number ({error})") from error

    def endElement(self, name: str) -> None:
        if name in ("way", "relation", "poly"):
            self._open = None

    def _add(self, name: str, attrs: Mapping[str, str]) -> None:
        if name == "node":
            place = (float(attrs["lon"]), float(attrs["lat"]))
            self.places[attrs["id"]] = _finite(place)
        elif name in ("way", "relation"):
            self._open = _Element(f"{name} {attrs['id']}", self._locator.getLineNumber())
            if name == "way":
                self.ways[attrs["id"]] = self._open
            else:
                self.relations.append(self._open)
        elif name == "nd" and self._open is not None:
            self._open.nodes.append(attrs["ref"])
        elif name == "member" and self._open is not None:
            if attrs["type"] == "way" and attrs.get("role") in ("outer", "inner", ""):
                self._open.ways.append(attrs["ref"])
        elif name == "tag" and self._open is not None:
            self._open.tags[attrs["k"]] = attrs["v"]
        elif name == "location":
            self._check_location(attrs)
        elif name == "poly" and attrs.get("type", "").startswith("building"):
            self._open = _Element(f"poly {attrs['id']}", self._locator.getLineNumber())
            self.polygons.append((self._open, self._ring(attrs)))
        elif name == "param" and self._open is not None:
            self._open.tags[attrs["key"]] = attrs["value"]

    def _ring(self, attrs: Mapping[str, str]) -> Ring:
        places = [
            _finite(tuple(map(float, word.split(",")[:2]))) for word in attrs["shape"].split()
        ]
        ring = np.array(places, dtype=np.float64).reshape(-1, 2)
        if attrs.get("geo", "false") in ("1", "true"):
            ring = _project(self._path, ring, self._geo)
        return ring

    def _check_location(self, attrs: Mapping[str, str]) -> None:
        """Raise an error for polygons that were made for a network at another place."""
        offset = tuple(map(float, attrs["netOffset"].split(",")))
        geo = self._geo
        ours = (0.0, 0.0) if geo is None else (geo.offset_x_m, geo.offset_y_m)
        if math.dist(offset, ours) > 0.01:
            raise self._error(
                "location",
                f"has the offset {attrs['netOffset']}, but the map has "
                f"{ours[0]:.2f},{ours[1]:.2f}: these buildings belong to another network",
            )

    def _error(self, name: str, problem: str) -> MapError:
        return MapError(
            f"{self._path}, line {self._locator.getLineNumber()}: <{name}> {problem}: export the "
            "file again for this map"
        )


def _finite(place: tuple[float, ...]) -> tuple[float, float]:
    x, y = place
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError(f"{x}, {y}")
    return x, y


def _osm_buildings(path: Path, osm: _Reader, geo: GeoReference | None) -> Iterator[Footprint]:
    """Yield the buildings among closed ways and multipolygons; incomplete rings are left out."""
    for element in [*osm.ways.values(), *osm.relations]:
        if not element.is_building:
            continue
        ways = [element.nodes] if element.nodes else [
            osm.ways[way].nodes for way in element.ways if way in osm.ways
        ]  # fmt: skip
        closed = [
            np.array([osm.places[node] for node in nodes[:-1]])
            for nodes in _closed(ways)
            if all(node in osm.places for node in nodes)
        ]
        rings = _rings([_project(path, ring, geo) for ring in closed])
        if rings:
            yield Footprint(element.name, rings, _height_m(element.tags), element.layer)


def _closed(ways: list[list[str]]) -> list[list[str]]:
    found, open_ways = [], []
    for way in ways:
        if len(way) >= 4 and way[0] == way[-1]:
            found.append(way)
        elif len(way) >= 2:
            open_ways.append(list(way))
    while open_ways:
        ring = open_ways.pop(0)
        while ring[0] != ring[-1]:
            following = next((way for way in open_ways if ring[-1] in (way[0], way[-1])), None)
            if following is None:
                break
            open_ways.remove(following)
            ring += following[1:] if following[0] == ring[-1] else following[-2::-1]
        if ring[0] == ring[-1] and len(ring) >= 4:
            found.append(ring)
    return found


def _rings(rings: list[Ring]) -> tuple[Ring, ...]:
    """Return rings of at least three corners, rounded to µm, without the repeated first corner."""
    rounded = [np.round(ring, _DIGITS) for ring in rings]
    opened = [ring[:-1] if len(ring) and (ring[0] == ring[-1]).all() else ring for ring in rounded]
    return tuple(ring for ring in opened if len(ring) >= 3)


def _height_m(tags: Mapping[str, str]) -> float:
    """Return the height from `height`, else from `building:levels`, else the default."""
    for key, unit_m in (("height", 1.0), ("building:levels", LEVEL_M)):
        number = _number(tags, key)
        if number is not None and 0.0 < number * unit_m <= _MOST_HEIGHT_M:
            return number * unit_m
    return DEFAULT_HEIGHT_M


def _number(tags: Mapping[str, str], key: str) -> float | None:
    """Return the number in a tag, without its unit; None if there is none."""
    match = _METRES.fullmatch(tags.get(key, ""))
    return None if match is None else float(match[1])


def _project(path: Path, ring: Ring, geo: GeoReference | None) -> Ring:
    """Return positions on the map for longitudes and latitudes (n, 2)."""
    if geo is None:
        raise MapError(
            f"{path}: its buildings have geographic coordinates, but the map has no "
            "georeference: build it with a projection, or give buildings in the map's own frame"
        )
    return project(path, ring, geo)


# No sensor reaches buildings farther than this from the bounding box of all roads.
FARTHEST_M = 300.0
LARGEST_M = 5000.0
MOST_CORNERS = 4000


def with_buildings(network: RoadNetwork, path: Path) -> RoadNetwork:
    """Return a network with the buildings of a file.

    A building with a layer above 0 over a lane is taken to bridge the road, and is left out.

    Returns:
        A network whose `source_hash` covers both files.

    Raises:
        MapError: see `read_footprints`; or no building is on the map, or a building is too large.
    """
    found = read_footprints(path, network.geo)
    near = [footprint for footprint in found if _is_near(network, footprint)]
    for footprint in near:
        _check_size(path, footprint)
    if not near:
        raise MapError(
            f"{path}: none of its {len(found)} buildings is within {FARTHEST_M:g} m of the map "
            f"'{network.name}': give the file from which this map was built"
        )
    parts = [convex_parts(footprint.rings) for footprint in near]
    stands = [
        footprint.layer <= 0.0 or not len(points_inside(network, there))
        for footprint, there in zip(near, parts, strict=True)
    ]
    near, parts = list(compress(near, stands)), list(compress(parts, stands))
    digest = hashlib.sha256(f"{network.source_hash}\0buildings={source_hash(path)}".encode())
    return replace(
        network,
        source_hash=digest.hexdigest(),
        walls=walls_of(near),
        roofs=np.concatenate([np.zeros((0, 4, 2)), *parts]),
        roof_height=np.repeat([footprint.height_m for footprint in near], list(map(len, parts))),
    )


def _is_near(network: RoadNetwork, footprint: Footprint) -> bool:
    corners = np.concatenate(footprint.rings)
    min_x, min_y, max_x, max_y = network.extent_m
    low, high = corners.min(axis=0), corners.max(axis=0)
    return bool(
        (high >= np.array([min_x, min_y]) - FARTHEST_M).all()
        and (low <= np.array([max_x, max_y]) + FARTHEST_M).all()
    )


def _check_size(path: Path, footprint: Footprint) -> None:
    """Raise an error for an object that is too large for a building and for the memory."""
    corners = np.concatenate(footprint.rings)
    size_m = float(np.ptp(corners, axis=0).max())
    if size_m > LARGEST_M or len(corners) > MOST_CORNERS:
        raise MapError(
            f"{path}: {footprint.name} is {size_m:.0f} m long and has {len(corners)} corners; at "
            f"most {LARGEST_M:g} m and {MOST_CORNERS} are allowed: remove it"
        )


def walls_of(footprints: list[Footprint]) -> NDArray[np.void]:
    """Return WALL (num_walls,): the sides of all rings, sorted by building."""
    rows = [
        (*start, *end, footprint.height_m, number)
        for number, footprint in enumerate(footprints)
        for ring in footprint.rings
        for start, end in pairwise([*ring, ring[0]])
        if (start != end).any()
    ]
    return np.array(rows, dtype=WALL)


def points_inside(network: RoadNetwork, roofs: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the rows of `network.points` inside convex parts (n, 4, 2) or on their borders."""
    places = np.stack([network.points["x"], network.points["y"]], axis=1)
    is_inside = np.zeros(len(places), dtype=np.bool_)
    for roof in roofs:
        low, high = roof.min(axis=0), roof.max(axis=0)
        near = np.flatnonzero(((places >= low) & (places <= high)).all(axis=1))
        along = np.roll(roof, -1, axis=0) - roof
        apart = places[near, np.newaxis] - roof
        side = along[:, 0] * apart[..., 1] - along[:, 1] * apart[..., 0]
        is_inside[near] |= (side >= 0.0).all(axis=1) | (side <= 0.0).all(axis=1)
    return np.flatnonzero(is_inside)


def convex_parts(rings: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
    """Return the inside of some rings as trapezoids (n, 4, 2), by the even-odd rule.

    Horizontal lines through all corners divide the plane into strips. The sides that pass through a
    strip, sorted from left to right, bound the inside in pairs. If sides cross, which does not
    happen in valid footprints, the parts overlap a little.
    """
    sides = np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings])
    low = sides[:, :, 1].min(axis=1)
    high = sides[:, :, 1].max(axis=1)
    parts: list[NDArray[np.float64]] = []
    levels = np.unique(sides[:, :, 1])
    for bottom, top in pairwise(levels):
        through = sides[(low <= bottom) & (high >= top)]
        rise = through[:, 1, 1] - through[:, 0, 1]
        slope = (through[:, 1, 0] - through[:, 0, 0]) / rise
        x_bottom = through[:, 0, 0] + (bottom - through[:, 0, 1]) * slope
        x_top = through[:, 0, 0] + (top - through[:, 0, 1]) * slope
        order = np.argsort(x_bottom + x_top, kind="stable")
        for left, right in zip(order[::2], order[1::2], strict=True):
            parts.append(
                np.array(
                    [
                        (x_bottom[left], bottom),
                        (x_bottom[right], bottom),
                        (x_top[right], top),
                        (x_top[left], top),
                    ]
                )
            )
    return np.stack(parts) if parts else np.zeros((0, 4, 2))
