"""The road segments that `kernels.puffer_drive` shows, and what is seen from each cell of a map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.nearest_road_points import (
    TYPE_EDGE,
    TYPE_JUNCTION,
    TYPE_LANE,
    TYPE_LINE,
)
from cavmarl.sensors.kernels.puffer_drive_kernel import (
    CELL_M,
    MAX_IN_CELL,
    ROAD_SEGMENT,
    SPIRAL_CELLS,
    list_segments,
)
from cavmarl.sensors.kernels.sensor_arrays import RoadSegments
from cavmarl.sensors.observed.road_points import lines_along

__all__ = ["drive_lines", "road_segments", "spiral"]

# pufferlib's types, counted from its lanes.
DRIVE_TYPES = {TYPE_LANE: 0, TYPE_JUNCTION: 0, TYPE_LINE: 1, TYPE_EDGE: 2}

MAX_LISTED = 100_000_000  # entries of all cells' lists: 400 MB

Line = tuple[NDArray[np.float32], int]


def drive_lines(network: RoadNetwork, spacing_m: float) -> tuple[list[Line], tuple[float, float]]:
    """The lines of a map and its corner.

    Args:
        network: the roads.
        spacing_m: longest segment of a line.

    Returns:
        ((n, 2) places in m from the corner, type) a line; x and y of the corner.
    """
    lines = [
        line for lane in range(len(network.lanes)) for line in lines_along(network, lane, spacing_m)
    ]
    min_x = min(float(line["x"].min()) for line in lines)
    min_y = min(float(line["y"].min()) for line in lines)
    return [
        (
            np.stack([line["x"] - min_x, line["y"] - min_y], axis=1).astype(np.float32),
            DRIVE_TYPES[int(line["type"][0])],
        )
        for line in lines
    ], (min_x, min_y)


def road_segments(network: RoadNetwork, spacing_m: float, most: int) -> RoadSegments:
    """The segments of a map by cell, and for each cell the list of those that are seen from it.

    Args:
        network: the roads.
        spacing_m: longest segment.
        most: entries of a list.

    Raises:
        ConfigError: the map is too large for lists of that length.
    """
    lines, (min_x, min_y) = drive_lines(network, spacing_m)
    far = np.max([line.max(axis=0) for line, _ in lines], axis=0)
    num_x, num_y = (max(int(size), 1) for size in np.ceil(far / CELL_M))
    cells = num_x * num_y
    if cells * most > MAX_LISTED:
        raise ConfigError(
            f"sensors.puffer_drive.segments = {most}: lists of that length for each cell of "
            f"{CELL_M:g} m of a map of {far[0] / 1e3:.1f} x {far[1] / 1e3:.1f} km would take "
            f"{cells * most * 4 / 1e9:.1f} GB; use sensors.roadgraph, or a part of the map"
        )
    segments = np.concatenate([_segments(line, kind) for line, kind in lines])
    columns = (segments["x"] / CELL_M).astype(np.int64)
    rows = (segments["y"] / CELL_M).astype(np.int64)
    inside = (columns < num_x) & (rows < num_y)
    segments, start = _by_cell(segments[inside], (rows * num_x + columns)[inside], cells)
    list_start = np.zeros(cells + 1, dtype=np.int64)
    room = np.zeros(cells * most, dtype=np.uint32)
    total = list_segments(start, num_x, num_y, spiral(SPIRAL_CELLS), most, list_start, room)
    lists = room[:total].copy()
    for array in (segments, list_start, lists):
        array.setflags(write=False)
    return RoadSegments(min_x, min_y, num_x, num_y, list_start, lists, segments)


def _segments(line: NDArray[np.float32], kind: int) -> NDArray[np.void]:
    """A line's segments; those without a length have no direction, as in pufferlib."""
    segments = np.zeros(len(line) - 1, dtype=ROAD_SEGMENT)
    middle = (line[:-1] + line[1:]) / np.float32(2.0)
    ahead = line[1:] - middle
    half = np.sqrt(ahead[:, 0] * ahead[:, 0] + ahead[:, 1] * ahead[:, 1])
    segments["x"], segments["y"] = middle.T
    segments["half"] = half / np.float32(100.0)
    length = np.where(half > 0.0, half, np.float32(1.0))
    segments["cos"], segments["sin"] = (ahead / length[:, None]).T
    segments["type"] = kind
    return segments


def _by_cell(
    segments: NDArray[np.void], cell: NDArray[np.int64], cells: int
) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """The first `MAX_IN_CELL` segments of each cell, cell by cell, and where each cell begins."""
    order = np.argsort(cell, kind="stable")
    cell = cell[order]
    rank = np.arange(len(cell)) - np.searchsorted(cell, cell)
    kept = rank < MAX_IN_CELL
    start = np.zeros(cells + 1, dtype=np.int32)
    start[1:] = np.cumsum(np.bincount(cell[kept], minlength=cells))
    return segments[order[kept]], start


def spiral(side: int) -> NDArray[np.int64]:
    """Columns and rows (side², 2) of a square of cells around its middle, from there outwards.

    To the right, up, left, down, with sides that grow by one cell after every second turn.
    """
    steps = [(0, 0)]
    turn = 0
    while len(steps) < side * side:
        across, up = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn % 4]
        steps += [(across, up)] * (turn // 2 + 1)
        turn += 1
    return np.cumsum(np.array(steps[: side * side], dtype=np.int64), axis=0)
