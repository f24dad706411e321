"""Exports Lanelet2 files (.osm), written and read back by the package lanelet2.

Autoware needs these tags (autoware-documentation, vector map requirements): turn directions of
lanelets inside junctions, `local_x` and `local_y` of points in the map's own coordinates, and
traffic lights, stop lines and rights of way as regulatory elements.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError, require
from cavmarl.maps.exports.geojson import unproject_points
from cavmarl.maps.projection import unproject
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork

_CAR = 1 << VEHICLE_CLASSES.index("passenger")
_BICYCLE = 1 << VEHICLE_CLASSES.index("bicycle")
_TURNS = {"s": "straight", "l": "left", "L": "left", "t": "left", "r": "right", "R": "right"}
# The id of a regulatory element is one of these, plus the row of its link.
FIRST_LIGHT, FIRST_RIGHT = 1_000_000_000, 2_000_000_000
# Degrees of the origin of a map without a georeference, of which only local_x and local_y count.
_NOWHERE = 45.0, 3.0
_LIGHT_HEIGHT_M, _LIGHT_SIZE_M = 5.0, 0.5  # a light is this far above the stop line


def write_lanelet2(network: RoadNetwork, target: Path, is_local: bool = False) -> dict[str, int]:
    """Write each lane as a lanelet; return the numbers of lanelets and rules, and those read back.

    Lanelets of lanes that lead into each other share end points, so that routes are connected. A
    link with a signal has a traffic light, whose id is `FIRST_LIGHT` plus the row of the link. A
    link that gives way to others has a right of way, `FIRST_RIGHT` plus its row; at a signal, it
    counts while both have green. Lanes without cars have `participant:vehicle` = no.

    `is_local`: the file is read by `local_x` and `local_y`, so the map needs no projection.

    Raises:
        MapError: the map has no projection, the target cannot be written, or the number of lanelets
            read back differs.
        MissingExtraError: lanelet2 or pyproj is not installed.
    """
    if network.geo is None and not is_local:
        raise MapError(
            f"{network.name}: the map has no georeference, and Lanelet2 needs degrees: "
            "build it from OpenStreetMap, or with a projParameter"
        )
    lanelet2: Any = require("lanelet2", "lanelet2")
    from lanelet2.core import AttributeMap, Lanelet, LaneletMap, LineString3d, Point3d
    from lanelet2.projection import UtmProjector

    if network.geo is None:
        south, west = _NOWHERE
    else:
        west, south = unproject_points(network).min(axis=0).tolist()
    projector = UtmProjector(lanelet2.io.Origin(south, west))
    made, ends = LaneletMap(), _Joints(network, projector)
    ids = itertools.count(1)

    def line(lane: int, side: float) -> Any:
        places = _beside(network, lane, side)
        degrees = ends.degrees(places[:, :2])
        points = []
        for n, ((lon, lat), z) in enumerate(zip(degrees.tolist(), places[:, 2], strict=True)):
            key = ends.key(places[n]) if n in (0, len(places) - 1) else None
            if key is None or key not in ends.points:
                at = projector.forward(lanelet2.core.GPSPoint(lat, lon, float(z)))
                point = Point3d(next(ids), at.x, at.y, float(z))
                point.attributes["local_x"] = f"{places[n, 0]:.3f}"
                point.attributes["local_y"] = f"{places[n, 1]:.3f}"
                if key is not None:
                    ends.points[key] = point
            else:
                point = ends.points[key]
            points.append(point)
        return LineString3d(next(ids), points, AttributeMap({"type": "line_thin"}))

    lanelets = []
    for lane, row in enumerate(network.lanes):
        attributes = {
            "type": "lanelet",
            "subtype": "road" if int(row["permissions"]) != _BICYCLE else "bicycle_lane",
            "location": "urban",
            "one_way": "yes",
            "participant:vehicle": "yes" if int(row["permissions"]) & _CAR else "no",
            "speed_limit": f"{row['speed_mps'] * 3.6:.1f} km/h",
            "name": network.lane_ids[lane],
        }
        if row["internal"] and row["link"] >= 0:
            direction = chr(network.links["direction"][row["link"]])
            attributes["turn_direction"] = _TURNS[direction]
        left, right = line(lane, 0.5), line(lane, -0.5)
        lanelets.append(Lanelet(next(ids), left, right, AttributeMap(attributes)))
    rules = _add_rules(network, lanelets, ids)
    for one in lanelets:
        made.add(one)
    try:
        lanelet2.io.write(str(target), made, projector)
        back = lanelet2.io.load(str(target), projector)
    except RuntimeError as error:
        raise MapError(f"{target}: cannot be written as Lanelet2 ({error})") from error
    counts = {"lanelets": len(made.laneletLayer), "read back": len(back.laneletLayer)}
    counts |= {"rules": rules, "rules read back": len(back.regulatoryElementLayer)}
    if counts["lanelets"] != counts["read back"] or counts["rules"] != counts["rules read back"]:
        raise MapError(f"{target}: numbers of elements differ ({counts}): export it again")
    return counts


def _add_rules(network: RoadNetwork, lanelets: list[Any], ids: Iterator[int]) -> int:
    """Add traffic lights and rights of way inside junctions, and return their number."""
    from lanelet2.core import (
        AttributeMap,
        LineString3d,
        Point3d,
        RightOfWay,
        TrafficLight,
    )

    stop_lines: dict[int, Any] = {}  # of each lane before a junction
    lights: dict[int, Any] = {}

    def stop_line(lane: int) -> Any:
        if lane not in stop_lines:
            ends = lanelets[lane].leftBound[-1], lanelets[lane].rightBound[-1]
            kind = AttributeMap({"type": "stop_line"})
            stop_lines[lane] = LineString3d(next(ids), list(ends), kind)
        return stop_lines[lane]

    def light(lane: int) -> Any:
        if lane not in lights:
            ends = [lanelets[lane].leftBound[-1], lanelets[lane].rightBound[-1]]
            # from the lower left corner to the lower right corner, as its driver sees it
            points = [Point3d(next(ids), end.x, end.y, end.z + _LIGHT_HEIGHT_M) for end in ends]
            for point, end in zip(points, ends, strict=True):
                for key in ("local_x", "local_y"):
                    point.attributes[key] = end.attributes[key]
            kind = {"type": "traffic_light", "subtype": "red_yellow_green"}
            kind["height"] = f"{_LIGHT_SIZE_M:g}"
            lights[lane] = LineString3d(next(ids), points, AttributeMap(kind))
        return lights[lane]

    count_rules = 0
    for number, link in enumerate(network.links):
        own, before = int(link["first_internal"]), int(link["from_lane"])
        if own < 0:
            continue
        if link["signal"] >= 0:
            rule: Any = TrafficLight(
                FIRST_LIGHT + number, AttributeMap(), [light(before)], stop_line(before)
            )
            lanelets[own].addRegulatoryElement(rule)
            count_rules += 1
        first, count = int(link["first_conflict"]), int(link["num_conflicts"])
        conflicts = network.conflicts[first : first + count]
        foes = network.links["first_internal"][conflicts["foe"][conflicts["must_yield"]]]
        foes = sorted({int(foe) for foe in foes if foe >= 0})
        if foes:
            rule = RightOfWay(
                FIRST_RIGHT + number,
                AttributeMap(),
                [lanelets[foe] for foe in foes],
                [lanelets[own]],
                stop_line(before),
            )
            for one in (own, *foes):
                lanelets[one].addRegulatoryElement(rule)
            count_rules += 1
    return count_rules


class _Joints:
    """End points, shared by lanelets that lead into each other."""

    def __init__(self, network: RoadNetwork, projector: Any) -> None:
        self.points: dict[tuple[int, int, int], Any] = {}
        self._geo, self._projector = network.geo, projector

    def key(self, place: NDArray[np.float64]) -> tuple[int, int, int]:
        x, y, z = np.round(place * 4.0).astype(int).tolist()
        return x, y, z

    def degrees(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._geo is not None:
            return unproject(places, self._geo)
        from lanelet2.core import BasicPoint3d

        found = [self._projector.reverse(BasicPoint3d(x, y, 0.0)) for x, y in places.tolist()]
        return np.array([(one.lon, one.lat) for one in found])


def _beside(network: RoadNetwork, lane: int, side: float) -> NDArray[np.float64]:
    """Return the border of a lane, `side` widths to the left of its centre line."""
    shape = network.lane_polyline(lane)
    along = np.gradient(shape[:, :2], axis=0)
    length = np.maximum(np.hypot(*along.T), 1e-9)
    shift = side * float(network.lanes["width_m"][lane]) / length
    border = shape.copy()
    border[:, 0] -= along[:, 1] * shift
    border[:, 1] += along[:, 0] * shift
    return border
