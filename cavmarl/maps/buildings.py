"""Buildings on a map: walls that rays end at, and their footprints in convex parts."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.maps.footprints import Footprint, read_footprints
from cavmarl.roads.kernels.backdrop_pieces import WALL
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import source_hash

# Buildings that are farther from every road's bounding box than any sensor sees are left out.
FARTHEST_M = 300.0
LARGEST_M = 5000.0
MOST_CORNERS = 4000


def with_buildings(network: RoadNetwork, path: Path) -> RoadNetwork:
    """A network with the buildings of a file.

    Returns:
        A network with another `source_hash`, for it has more than one source.

    Raises:
        MapError: see `read_footprints`; or no building of the file lies on the map, or one of them
            is too large to be any.
    """
    found = read_footprints(path, network.geo)
    near = [footprint for footprint in found if _is_near(network, footprint)]
    for footprint in near:
        _check_size(path, footprint)
    if not near:
        raise MapError(
            f"{path}: none of its {len(found)} buildings lies within {FARTHEST_M:g} m of the map "
            f"'{network.name}': give the file that this map was made of"
        )
    parts = [convex_parts(footprint.rings) for footprint in near]
    digest = hashlib.sha256(f"{network.source_hash}\0buildings={source_hash(path)}".encode())
    return replace(
        network,
        source_hash=digest.hexdigest(),
        walls=walls_of(near),
        roofs=np.concatenate(parts),
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
    """Refuse what would take all memory or time, and is no building."""
    corners = np.concatenate(footprint.rings)
    size_m = float(np.ptp(corners, axis=0).max())
    if size_m > LARGEST_M or len(corners) > MOST_CORNERS:
        raise MapError(
            f"{path}: {footprint.name} is {size_m:.0f} m long and has {len(corners)} corners, more "
            f"than {LARGEST_M:g} m or {MOST_CORNERS}: remove it"
        )


def walls_of(footprints: list[Footprint]) -> NDArray[np.void]:
    """WALL (num_walls,): the sides of all rings, building by building."""
    rows = [
        (*start, *end, footprint.height_m, number)
        for number, footprint in enumerate(footprints)
        for ring in footprint.rings
        for start, end in pairwise([*ring, ring[0]])
        if (start != end).any()
    ]
    return np.array(rows, dtype=WALL)


def convex_parts(rings: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
    """The inside of some rings as trapezoids (n, 4, 2), by the even-odd rule.

    Between the heights of two neighbouring corners the sides that pass through, sorted from left to
    right, bound the inside by pairs. Where sides cross each other between corners, which footprints
    do not, the parts overlap a little.
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
