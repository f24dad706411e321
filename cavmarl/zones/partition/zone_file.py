"""Zone files, which store a partition without loss.

    {"schema": "cavmarl.zones", "version": 1,
     "bounds_m": [0.0, 0.0, 200.0, 100.0],
     "zones": [{"id": 0, "rect_m": [0.0, 0.0, 120.0, 100.0]},
               {"id": 1, "rect_m": [120.0, 0.0, 200.0, 100.0]}]}

The file is JSON or YAML. The rectangles (min_x, min_y, max_x, max_y) tile `bounds_m`; sides on
`bounds_m` extend to infinity. Ids are 0 to k - 1, in any order.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from cavmarl.config.zones import MAX_ZONES, ZONE_FILE_SUFFIXES, ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_partition import Bounds, ZonePartition

SCHEMA = "cavmarl.zones"
VERSION = 1
DEFAULT_COUNT = 4


@dataclass(frozen=True)
class _Zone:
    id: int
    rect_m: Bounds


@dataclass(frozen=True)
class _Document:
    schema: Literal["cavmarl.zones"]
    version: Literal[1]
    bounds_m: Bounds
    zones: tuple[_Zone, ...]


def read_zones(path: str | Path) -> ZonePartition:
    from cavmarl.config.io import read_yaml, validate

    path = Path(path)
    document = validate(_Document, read_yaml(path), str(path))
    ids = [zone.id for zone in document.zones]
    count = len(ids)
    if count > MAX_ZONES:
        raise ConfigError(f"{path}: there are {count} zones; use at most {MAX_ZONES}")
    for number in ids:
        if ids.count(number) > 1:
            raise ConfigError(f"{path}: {ids.count(number)} zones have id {number}; renumber them")
    missing = sorted(set(range(count)) - set(ids))
    if missing:
        raise ConfigError(
            f"{path}: no zone has the id {missing[0]}; number the zones from 0 to {count - 1}"
        )
    rects = np.array([zone.rect_m for zone in sorted(document.zones, key=lambda zone: zone.id)])
    try:
        return ZonePartition(document.bounds_m, rects)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def zones_for(network: RoadNetwork, path: str | Path, count: int | None) -> ZonePartition:
    """Return a zone file's partition. Raises ConfigError: map or number of zones do not match."""
    partition = read_zones(path)
    if count is not None and partition.count != count:
        raise ConfigError(
            f"zones.count = {count}: {path} has {partition.count} zones; use {partition.count}"
        )
    extent, bounds = np.array(network.extent_m), np.array(partition.bounds)
    if (extent[:2] < bounds[:2]).any() or (extent[2:] > bounds[2:]).any():
        raise ConfigError(
            f"{path}: bounds_m = {list(partition.bounds)} does not contain the roads of "
            f"'{network.name}', which extend from {extent[:2].tolist()} to {extent[2:].tolist()}; "
            "use a zone file of this map, or make one with `cavmarl map zones`"
        )
    return partition


def named_zones(
    network: RoadNetwork,
    layout: str,  # one of ZONE_LAYOUTS, or the path of a zone file
    count: int | None,  # number of zones; None: as in the file, or 4 for a layout
    *,
    avoid_junctions: bool = False,  # see `cut_map`
    weight: str = "lane_length",  # see `cut_map`
) -> ZonePartition:
    """Return the partition of a zone file, or the map cut by a layout."""
    if layout in ZONE_LAYOUTS:
        return cut_map(
            network,
            layout,
            DEFAULT_COUNT if count is None else count,
            avoid_junctions=avoid_junctions,
            weight=weight,
        )
    if layout.endswith(ZONE_FILE_SUFFIXES):
        return zones_for(network, layout, count)
    raise ConfigError(
        f"layout '{layout}' does not exist; use {', '.join(ZONE_LAYOUTS)}, or the path of a zone "
        f"file ({', '.join(ZONE_FILE_SUFFIXES)})"
    )


def write_zones(path: str | Path, partition: ZonePartition) -> None:
    zones = ",\n".join(
        "  " + json.dumps({"id": zone, "rect_m": rect})
        for zone, rect in enumerate(partition.rects.tolist())
    )
    head = json.dumps({"schema": SCHEMA, "version": VERSION, "bounds_m": list(partition.bounds)})
    try:
        Path(path).write_text(f'{head[:-1]},\n "zones": [\n{zones}]}}\n', encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
