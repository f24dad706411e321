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

from cavmarl.core.errors import ConfigError, MapError, require
from cavmarl.core.records.codes import (
    NO_CHANGE_LEFT,
    NO_CHANGE_RIGHT,
    SIGNAL_GREEN_MAJOR,
    SIGNAL_GREEN_MINOR,
)
from cavmarl.maps.exports.geojson import unproject_points
from cavmarl.maps.exports.lane_borders import LEFT, RIGHT, LaneBorders
from cavmarl.maps.projection import unproject
from cavmarl.roads.network import CARS, VEHICLE_CLASSES, RoadNetwork

_BICYCLE = 1 << VEHICLE_CLASSES.index("bicycle")
_TURNS = {"s": "straight", "l": "left", "L": "left", "t": "left", "r": "right", "R": "right"}
# The id of a regulatory element is one of these, plus the row of its link.
FIRST_LIGHT, FIRST_RIGHT = 1_000_000_000, 2_000_000_000
# Origin in degrees for a map without a georeference, for which only local_x and local_y count.
_NOWHERE = 45.0, 3.0
_LIGHT_HEIGHT_M, _LIGHT_SIZE_M = 5.0, 0.5  # a light is this far above the stop line


def write_lanelet2(network: RoadNetwork, target: Path, is_local: bool = False) -> dict[str, int]:
    """Write each lane as a lanelet; return numbers of elements, written and as read back.

    Lanelets of lanes that lead into each other share end points, and lanelets of neighbours share a
    border, so that routes are connected. A link with a signal has a traffic light, whose id is
    `FIRST_LIGHT` plus the row of the link. A link that gives way to others has a right-of-way
    element with the id `FIRST_RIGHT` plus the row. Lanes without cars have `participant:vehicle` =
    no.

    `is_local`: the file is read by `local_x` and `local_y`, so the map needs no projection.

    Raises:
        MapError: the map has no projection, the target cannot be written, or the numbers of
            lanelets or regulatory elements read back differ.
        MissingExtraError: lanelet2 or pyproj is not installed.
    """
    if network.geo is None and not is_local:
        raise MapError(
            f"{network.name}: the map has no georeference, and Lanelet2 needs degrees: "
            "build it from OpenStreetMap, or with a projParameter"
        )
    lanelet2: Any = require("lanelet2", "lanelet2")
    from lanelet2.core import AttributeMap, Lanelet, LaneletMap
    from lanelet2.projection import UtmProjector

    if network.geo is None:
        south, west = _NOWHERE
    else:
        west, south = unproject_points(network).min(axis=0).tolist()
    projector = UtmProjector(lanelet2.io.Origin(south, west))
    made, ids = LaneletMap(), itertools.count(1)
    lines = _border_lines(network, projector, ids)
    lanelets = []
    for lane, row in enumerate(network.lanes):
        attributes = {
            "type": "lanelet",
            "subtype": "road" if int(row["permissions"]) != _BICYCLE else "bicycle_lane",
            "location": "urban",
            "one_way": "yes",
            "participant:vehicle": "yes" if int(row["permissions"]) & CARS else "no",
            "speed_limit": f"{row['speed_mps'] * 3.6:.1f} km/h",
            "name": network.lane_ids[lane],
        }
        if row["internal"] and row["link"] >= 0:
            direction = chr(network.links["direction"][row["link"]])
            attributes["turn_direction"] = _TURNS[direction]
        lanelets.append(Lanelet(next(ids), *lines[lane], AttributeMap(attributes)))
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


def write_map_folder(network: RoadNetwork, folder: Path) -> dict[str, int]:
    """Write a map folder of Autoware, and return what `write_lanelet2` returns.

    Raises:
        ConfigError: the folder cannot be made.
        MapError, MissingExtraError: as `write_lanelet2`.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error})") from error
    counts = write_lanelet2(network, folder / "lanelet2_map.osm", is_local=True)
    # Points have local_x and local_y, so Autoware's frame `map` is that of the map file.
    (folder / "map_projector_info.yaml").write_text("projector_type: Local\n", encoding="utf-8")
    return counts


def _border_lines(
    network: RoadNetwork, projector: Any, ids: Iterator[int]
) -> list[tuple[Any, Any]]:
    """Return the left and the right border of each lane."""
    from lanelet2.core import AttributeMap, BasicPoint3d, GPSPoint, LineString3d, Point3d

    borders = LaneBorders(network)
    ends: dict[int, Any] = {}

    def point(place: list[float], at: Any) -> Any:
        made = Point3d(next(ids), at.x, at.y, place[2])
        made.attributes["local_x"] = f"{place[0]:.3f}"
        made.attributes["local_y"] = f"{place[1]:.3f}"
        return made

    def line(lane: int, side: int) -> Any:
        places = borders.places[lane][side]
        if network.geo is None:
            on_map = [BasicPoint3d(*place) for place in places.tolist()]
        else:
            degrees = unproject(places[:, :2], network.geo).tolist()
            on_map = [projector.forward(GPSPoint(lat, lon, 0.0)) for lon, lat in degrees]
        points = []
        for n, (place, at) in enumerate(zip(places.tolist(), on_map, strict=True)):
            if 0 < n < len(places) - 1:
                points.append(point(place, at))
                continue
            joint = int(borders.joints[lane, side, int(n > 0)])
            if joint not in ends:
                ends[joint] = point(place, at)
            points.append(ends[joint])
        kind = {"type": "line_thin", "subtype": _line_of(network, lane, side)}
        return LineString3d(next(ids), points, AttributeMap(kind))

    right = [line(lane, RIGHT) for lane in range(len(network.lanes))]
    return [
        (right[borders.shared[lane]] if lane in borders.shared else line(lane, LEFT), right[lane])
        for lane in range(len(network.lanes))
    ]


def _line_of(network: RoadNetwork, lane: int, side: int) -> str:
    """Return the marking of a border: dashed where cars may change lanes in both directions."""
    other = int(network.lanes["left" if side == LEFT else "right"][lane])
    if other < 0:
        return "solid"
    bits = (NO_CHANGE_LEFT, NO_CHANGE_RIGHT) if side == LEFT else (NO_CHANGE_RIGHT, NO_CHANGE_LEFT)
    barred = any(
        int(network.lanes["permissions"][each]) >> bit & 1
        for each, bit in zip((lane, other), bits, strict=True)
    )
    return "solid" if barred else "dashed"


def yields_to(network: RoadNetwork, link: int) -> NDArray[np.int32]:
    """Return the links to which a link gives way.

    At a signal, a link gives way to a second link if it has minor green while the second has green.
    """
    links = network.links
    first, count = (int(links[name][link]) for name in ("first_conflict", "num_conflicts"))
    conflicts = network.conflicts[first : first + count]
    foes: NDArray[np.int32] = conflicts["foe"][conflicts["must_yield"]]
    signal = links["signal"][link]
    if signal < 0:
        return foes
    programs = network.programs[network.programs["signal"] == signal]
    phases = [
        network.phases["first_state"][first : first + count]
        for first, count in zip(programs["first_phase"], programs["num_phases"], strict=True)
    ]
    begins = np.concatenate(phases)
    is_minor = network.phase_states[begins + links["signal_index"][link]] == SIGNAL_GREEN_MINOR
    greens = (SIGNAL_GREEN_MINOR, SIGNAL_GREEN_MAJOR)
    met = [
        links["signal"][foe] != signal
        or (
            is_minor & np.isin(network.phase_states[begins + links["signal_index"][foe]], greens)
        ).any()
        for foe in foes
    ]
    return foes[np.array(met, dtype=np.bool_)]


def _add_rules(network: RoadNetwork, lanelets: list[Any], ids: Iterator[int]) -> int:
    """Add traffic lights and rights of way inside junctions, and return their number."""
    from lanelet2.core import (
        AttributeMap,
        LineString3d,
        Point3d,
        RightOfWay,
        TrafficLight,
    )

    stop_lines: dict[int, Any] = {}  # stop line of each lane before a junction
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
            # from the lower left to the lower right corner, as seen by a driver on the lane
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
        foes = sorted(
            {int(foe) for foe in network.links["first_internal"][yields_to(network, number)]}
        )
        foes = [foe for foe in foes if foe >= 0]
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
