"""Lanes as GeoJSON: longitude, latitude and height of their centre lines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.core.errors import MapError
from cavmarl.maps.projection import unproject
from cavmarl.maps.provenance import read_provenance
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork

_DEGREES_DIGITS, _HEIGHT_DIGITS = 8, 3


def write_geojson(network: RoadNetwork, target: Path, source: Path) -> int:
    """Write each lane outside junctions as a line; return the number of lanes.

    Args:
        network: a map with a georeference.
        target: the file to write.
        source: the map's file, whose licence and origin are copied.

    Raises:
        MapError: the map has no projection, or the target cannot be written.
        MissingExtraError: pyproj is not installed.
    """
    if network.geo is None:
        raise MapError(
            f"{network.name}: the map has no georeference, and GeoJSON needs degrees: "
            "build it from OpenStreetMap, or with a projParameter"
        )
    degrees = unproject_points(network)
    features = []
    for lane, row in enumerate(network.lanes):
        if row["internal"]:
            continue
        first, number = int(row["first_point"]), int(row["num_points"])
        line = [
            [round(lon, _DEGREES_DIGITS), round(lat, _DEGREES_DIGITS), round(z, _HEIGHT_DIGITS)]
            for (lon, lat), z in zip(
                degrees[first : first + number].tolist(),
                network.points["z"][first : first + number].tolist(),
                strict=True,
            )
        ]
        features.append(
            {
                "type": "Feature",
                "id": network.lane_ids[lane],
                "geometry": {"type": "LineString", "coordinates": line},
                "properties": _properties(network, lane),
            }
        )
    document = {
        "type": "FeatureCollection",
        "provenance": read_provenance(source),
        "features": features,
    }
    try:
        target.write_text(json.dumps(document, ensure_ascii=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise MapError(f"{target}: cannot be written ({error.strerror or error})") from error
    return len(features)


def unproject_points(network: RoadNetwork) -> Any:
    """Return longitudes and latitudes (n, 2) of all points of a map with a projection."""
    assert network.geo is not None
    return unproject(np.stack([network.points["x"], network.points["y"]], axis=1), network.geo)


def _properties(network: RoadNetwork, lane: int) -> dict[str, Any]:
    row = network.lanes[lane]
    allowed = [name for bit, name in enumerate(VEHICLE_CLASSES) if row["permissions"] >> bit & 1]
    return {
        "edge": network.edge_ids[row["edge"]],
        "index": int(row["index"]),
        "width_m": float(row["width_m"]),
        "speed_mps": float(row["speed_mps"]),
        "length_m": round(float(row["length_m"]), 2),
        "allowed": allowed,
    }
