"""Roads and zones whose vehicles cross borders at chosen times."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_partition import Bounds, ZonePartition

MARGIN_M = 10.0
Place = tuple[float, float]


def write_roads(path: Path, roads: Sequence[tuple[Place, Place]], speed_mps: float) -> Path:
    """Write a network of straight roads with one lane, `road0` and so on, without junctions."""
    parts = []
    for k, ((x, y), (end_x, end_y)) in enumerate(roads):
        length = float(np.hypot(end_x - x, end_y - y))
        parts.append(
            f'<edge id="road{k}" from="W{k}" to="E{k}"><lane id="road{k}_0" index="0" '
            f'speed="{speed_mps}" length="{length:.2f}" shape="{x},{y} {end_x},{end_y}"/></edge>'
        )
    for k, ((x, y), (end_x, end_y)) in enumerate(roads):
        parts.append(
            f'<junction id="W{k}" type="dead_end" x="{x}" y="{y}" incLanes="" intLanes="" '
            f'shape=""/><junction id="E{k}" type="dead_end" x="{end_x}" y="{end_y}" '
            f'incLanes="road{k}_0" intLanes="" shape=""/>'
        )
    corners = np.array(roads).reshape(-1, 2)
    (low_x, low_y), (high_x, high_y) = corners.min(axis=0), corners.max(axis=0)
    path.write_text(
        '<net version="1.20"><location netOffset="0,0" '
        f'convBoundary="{low_x},{low_y},{high_x},{high_y}" '
        f'origBoundary="{low_x},{low_y},{high_x},{high_y}" projParameter="!"/>'
        f"{''.join(parts)}</net>",
        encoding="utf-8",
    )
    return path


def write_platoon(path: Path, roads: int, place_m: float, speed_mps: float) -> Path:
    """Write one car per road; all cars drive alike, so they cross a border in the same tick."""
    cars = "".join(
        f'<vehicle id="{k}" type="car" depart="0" departPos="{place_m}" '
        f'departSpeed="{speed_mps}"><route edges="road{k}"/></vehicle>'
        for k in range(roads)
    )
    path.write_text(
        f'<routes><vType id="car" sigma="0" speedFactor="1" speedDev="0" maxSpeed="{speed_mps}"/>'
        f"{cars}</routes>",
        encoding="utf-8",
    )
    return path


def bounds_around(network: RoadNetwork) -> Bounds:
    """Return bounds around all roads."""
    low_x, low_y, high_x, high_y = network.extent_m
    return (low_x - MARGIN_M, low_y - MARGIN_M, high_x + MARGIN_M, high_y + MARGIN_M)


def cut_at(path: Path, bounds: Bounds, xs: Sequence[float], ys: Sequence[float] = ()) -> Path:
    """Write a zone file of a grid of zones with borders at these x and y."""
    columns = list(pairwise([bounds[0], *xs, bounds[2]]))
    rows = list(pairwise([bounds[1], *ys, bounds[3]]))
    rects = [[x, y, end_x, end_y] for x, end_x in columns for y, end_y in rows]
    write_zones(path, ZonePartition(bounds, np.array(rects)))
    return path
