"""Exports Lanelet2 files (.osm), written and read back by the package lanelet2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError, require
from cavmarl.maps.exports.geojson import unproject_points
from cavmarl.maps.projection import unproject
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork

_BICYCLE = 1 << VEHICLE_CLASSES.index("bicycle")


def write_lanelet2(network: RoadNetwork, target: Path) -> dict[str, int]:
    """Write each lane as a lanelet; return the numbers of lanelets written and read back.

    Lanelets of lanes that lead into each other share end points, so that routes are connected.

    Raises:
        MapError: the map has no projection, the target cannot be written, or the number of lanelets
            read back differs.
        MissingExtraError: lanelet2 or pyproj is not installed.
    """
    if network.geo is None:
        raise MapError(
            f"{network.name}: the map has no georeference, and Lanelet2 needs degrees: "
            "build it from OpenStreetMap, or with a projParameter"
        )
    lanelet2: Any = require("lanelet2", "lanelet2")
    from lanelet2.core import AttributeMap, Lanelet, LaneletMap, LineString3d, Point3d, getId
    from lanelet2.projection import UtmProjector

    west, south = unproject_points(network).min(axis=0).tolist()
    projector = UtmProjector(lanelet2.io.Origin(south, west))
    made, ends = LaneletMap(), _Joints(network)

    def line(lane: int, side: float) -> Any:
        places = _beside(network, lane, side)
        degrees = ends.degrees(places[:, :2])
        points = []
        for n, ((lon, lat), z) in enumerate(zip(degrees.tolist(), places[:, 2], strict=True)):
            key = ends.key(places[n]) if n in (0, len(places) - 1) else None
            if key is None or key not in ends.points:
                at = projector.forward(lanelet2.core.GPSPoint(lat, lon, float(z)))
                point = Point3d(getId(), at.x, at.y, float(z))
                if key is not None:
                    ends.points[key] = point
            else:
                point = ends.points[key]
            points.append(point)
        return LineString3d(getId(), points, AttributeMap({"type": "line_thin"}))

    for lane, row in enumerate(network.lanes):
        attributes = {
            "type": "lanelet",
            "subtype": "road" if int(row["permissions"]) != _BICYCLE else "bicycle_lane",
            "location": "urban",
            "one_way": "yes",
            "speed_limit": f"{row['speed_mps'] * 3.6:.1f} km/h",
            "name": network.lane_ids[lane],
        }
        made.add(Lanelet(getId(), line(lane, 0.5), line(lane, -0.5), AttributeMap(attributes)))
    try:
        lanelet2.io.write(str(target), made, projector)
        back = lanelet2.io.load(str(target), projector)
    except RuntimeError as error:
        raise MapError(f"{target}: cannot be written as Lanelet2 ({error})") from error
    counts = {"lanelets": len(made.laneletLayer), "read back": len(back.laneletLayer)}
    if counts["lanelets"] != counts["read back"]:
        raise MapError(f"{target}: numbers of lanelets differ ({counts}): export it again")
    return counts


class _Joints:
    """End points, shared by lanelets that lead into each other."""

    def __init__(self, network: RoadNetwork) -> None:
        assert network.geo is not None
        self.points: dict[tuple[int, int, int], Any] = {}
        self._geo = network.geo

    def key(self, place: NDArray[np.float64]) -> tuple[int, int, int]:
        x, y, z = np.round(place * 4.0).astype(int).tolist()
        return x, y, z

    def degrees(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        return unproject(places, self._geo)


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
