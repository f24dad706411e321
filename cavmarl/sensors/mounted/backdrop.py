"""The static scene for imaging sensors: lanes as strips, and buildings, in spatial indices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.math.neighbors import Grid, cell_at, make_grid
from cavmarl.core.records.codes import CLASS_PEDESTRIAN
from cavmarl.roads.kernels.backdrop_pieces import Backdrop
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.sensors.kernels.panorama import SEMANTIC_OF_CLASS

CELL_M = 32.0
# Longer straight strips are cut, because the index finds strips by their centres.
STRIP_M = 24.0
# Strips overlap slightly, so that no ground shows between neighbouring lanes.
OVERLAP_M = 0.05
# At a sharp bend, the mitre is at most this many half widths long.
LONGEST_MITRE = 2.0

_CLASS_NAMES = {**dict(enumerate(VEHICLE_CLASSES)), CLASS_PEDESTRIAN: "pedestrian"}


def make_backdrop(network: RoadNetwork, types: NDArray[np.void]) -> Backdrop:
    """Build the static scene of a map.

    `types`: VTYPE (num_types,) of the vehicles that sensors can see.

    Raises ConfigError: a vehicle class has no semantic class.
    """
    strips, lined = lane_strips(network)
    walls, roofs = network.walls, network.roofs
    ends = np.stack([[walls["ax"], walls["ay"]], [walls["bx"], walls["by"]]]).transpose(2, 0, 1)
    strip_index, by_strip = _index(strips)
    wall_index, by_wall = _index(ends)
    roof_index, by_roof = _index(roofs)
    return Backdrop(
        _semantics(types),
        strips[by_strip],
        lined[by_strip],
        strip_index,
        walls[by_wall],
        wall_index,
        roofs[by_roof],
        network.roof_height[by_roof],
        roof_index,
    )


def _semantics(types: NDArray[np.void]) -> NDArray[np.uint8]:
    """Return the semantic class (num_types,) of each type."""
    names = [_CLASS_NAMES.get(vclass, f"number {vclass}") for vclass in types["vclass"].tolist()]
    unknown = sorted(set(names) - set(SEMANTIC_OF_CLASS))
    if unknown:
        raise ConfigError(f"vehicle class {', '.join(unknown)}: add it to SEMANTIC_OF_CLASS")
    return np.array([SEMANTIC_OF_CLASS[name] for name in names], np.uint8)


def _index(corners: NDArray[np.float64]) -> tuple[Grid, NDArray[np.intp]]:
    """Index shapes (n, corners, 2) by their centres; return the index and its order."""
    if len(corners) == 0:
        return make_grid((0.0, 0.0, 1.0, 1.0), CELL_M, 0), np.zeros(0, np.intp)
    middles = corners.mean(axis=1)
    (min_x, min_y), (max_x, max_y) = middles.min(axis=0), middles.max(axis=0)
    grid = make_grid((float(min_x), float(min_y), float(max_x), float(max_y)), CELL_M, 0)
    cells = np.array([cell_at(grid, x, y) for x, y in middles])
    order = np.argsort(cells, kind="stable")
    grid.start[:] = np.searchsorted(cells[order], np.arange(len(grid.start)))
    apart = corners - middles[:, np.newaxis]
    grid.largest[0] = hypot_all(apart[..., 0], apart[..., 1]).max()
    return grid, order


def lane_strips(network: RoadNetwork) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cut the lanes of a map into convex pieces.

    Returns corners (n, 4, 2) in m: right and left at the start, left and right at the end;
    consecutive pieces of a lane share corners. Also returns flags (n,): 1 where the sides are lane
    lines, 0 inside junctions.
    """
    lanes, points = network.lanes, network.points
    of = np.repeat(np.arange(len(lanes)), lanes["num_points"])
    first = np.zeros(len(points), dtype=np.bool_)
    first[lanes["first_point"]] = True
    last = np.roll(first, -1)
    here = np.stack([points["x"], points["y"]], axis=1)
    after = np.stack([points["cos"], points["sin"]], axis=1)
    before = np.where(first[:, np.newaxis], after, np.roll(after, 1, axis=0))
    # The last point repeats the direction of the segment before it.
    along = before + after
    size = hypot_all(along[:, 0], along[:, 1])
    # A lane that reverses at a point has no mean direction there; use the direction after the turn.
    along = np.where(
        size[:, np.newaxis] > 1e-6, along / np.maximum(size, 1e-6)[:, np.newaxis], after
    )
    bend = np.abs(along[:, 0] * after[:, 0] + along[:, 1] * after[:, 1])
    mitre = np.minimum(1.0 / np.maximum(bend, 1e-6), LONGEST_MITRE)
    aside = (
        ((0.5 * lanes["width_m"][of] + OVERLAP_M) * mitre)[:, np.newaxis]
        * along[:, ::-1]
        * [-1.0, 1.0]
    )
    sides = np.stack([here - aside, here + aside], axis=1)
    start = np.flatnonzero(~last)
    length = points["s"][start + 1] - points["s"][start]
    parts = np.maximum(np.ceil(length / STRIP_M).astype(np.int64), 1)
    which = np.repeat(start, parts)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    corners = np.empty((len(which), 4, 2))
    for at, share in (((0, 1), part / np.repeat(parts, parts)),
                      ((3, 2), (part + 1) / np.repeat(parts, parts))):  # fmt: skip
        ends = share[:, np.newaxis, np.newaxis]
        corners[:, at] = (1.0 - ends) * sides[which] + ends * sides[which + 1]
    return corners, np.where(lanes["internal"][of[which]], 0.0, 1.0)
