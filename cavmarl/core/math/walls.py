"""Lines of sight between two points: straight walls in square cells, and bodies."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel

CELL_M = 50.0
# A line along the border of two cells is searched in both.
_MARGIN_M = 1e-6


class Walls(NamedTuple):
    """Line segments and the cells that they touch; never modified."""

    min_x: float  # m, corner of cell (0, 0)
    min_y: float
    cell_m: float
    num_x: int
    num_y: int
    start: NDArray[np.int32]  # (num_x * num_y + 1,) cell c has segments which[start[c] : …]
    which: NDArray[np.int32]
    segments: NDArray[np.float64]  # (n, 4) x, y, x, y in m


def make_walls(
    segments: NDArray[np.float64],  # (n, 4) ends x, y, x, y in m; may be empty
    cell_m: float = CELL_M,  # side of a cell
) -> Walls:
    """Sort walls into cells."""
    segments = np.ascontiguousarray(segments, dtype=np.float64).reshape(-1, 4)
    if len(segments) == 0:
        nothing = np.zeros(0, np.int32)
        return Walls(0.0, 0.0, cell_m, 0, 0, np.zeros(1, np.int32), nothing, segments)
    x, y = segments[:, 0::2], segments[:, 1::2]
    min_x, min_y = float(x.min()), float(y.min())
    num_x = int((x.max() - min_x) / cell_m) + 1
    num_y = int((y.max() - min_y) / cell_m) + 1
    # Each wall is listed in all cells of its bounding box: most walls are shorter than a cell.
    columns = np.floor((np.sort(x, axis=1) - min_x + (-_MARGIN_M, _MARGIN_M)) / cell_m)
    rows = np.floor((np.sort(y, axis=1) - min_y + (-_MARGIN_M, _MARGIN_M)) / cell_m)
    columns = np.clip(columns.astype(np.int64), 0, num_x - 1)
    rows = np.clip(rows.astype(np.int64), 0, num_y - 1)
    listed = [
        (j * num_x + i, wall)
        for wall in range(len(segments))
        for j in range(rows[wall, 0], rows[wall, 1] + 1)
        for i in range(columns[wall, 0], columns[wall, 1] + 1)
    ]
    pairs = np.array(sorted(listed), dtype=np.int64)
    start = np.searchsorted(pairs[:, 0], np.arange(num_x * num_y + 1)).astype(np.int32)
    which = pairs[:, 1].astype(np.int32)
    return Walls(min_x, min_y, cell_m, num_x, num_y, start, which, segments)


@kernel
def _crosses(wall: NDArray[np.float64], x: float, y: float, to_x: float, to_y: float) -> bool:
    """Return whether the line from (x, y) meets a wall, including its ends."""
    dx = to_x - x
    dy = to_y - y
    side_a = dx * (wall[1] - y) - dy * (wall[0] - x)
    side_b = dx * (wall[3] - y) - dy * (wall[2] - x)
    if side_a * side_b > 0.0:
        return False
    wall_dx = wall[2] - wall[0]
    wall_dy = wall[3] - wall[1]
    side_from = wall_dx * (y - wall[1]) - wall_dy * (x - wall[0])
    side_to = wall_dx * (to_y - wall[1]) - wall_dy * (to_x - wall[0])
    return bool(side_from * side_to <= 0.0 and (side_a != side_b or side_from != side_to))


@kernel
def _clamped(number: float, most: int) -> int:
    """Return the whole number below `number`, limited to [0, most]."""
    return int(min(max(math.floor(number), 0.0), float(most)))


@kernel
def is_cut(walls: Walls, x: float, y: float, to_x: float, to_y: float) -> bool:
    """Return whether a wall meets the straight line between two points in m.

    A wall along the line does not count, because the line of sight runs along the side of a house.
    """
    if walls.start.size == 1:
        return False
    if to_x < x:
        x, y, to_x, to_y = to_x, to_y, x, y
    first = _clamped((x - _MARGIN_M - walls.min_x) / walls.cell_m, walls.num_x - 1)
    last = _clamped((to_x + _MARGIN_M - walls.min_x) / walls.cell_m, walls.num_x - 1)
    slope = (to_y - y) / (to_x - x) if to_x - x > _MARGIN_M else math.inf
    for i in range(first, last + 1):
        low = y
        high = to_y
        if slope != math.inf:
            # Positions where the line enters and leaves the column.
            left = walls.min_x + i * walls.cell_m
            if i > first:
                low = y + (left - x) * slope
            if i < last:
                high = y + (left + walls.cell_m - x) * slope
        if low > high:
            low, high = high, low
        bottom = _clamped((low - _MARGIN_M - walls.min_y) / walls.cell_m, walls.num_y - 1)
        top = _clamped((high + _MARGIN_M - walls.min_y) / walls.cell_m, walls.num_y - 1)
        for j in range(bottom, top + 1):
            cell = j * walls.num_x + i
            for k in range(walls.start[cell], walls.start[cell + 1]):
                if _crosses(walls.segments[walls.which[k]], x, y, to_x, to_y):
                    return True
    return False


@kernel
def behind_body(body: np.void, x: float, y: float, cos: float, sin: float, far: float) -> float:
    """Return where a line of sight leaves a body that it crosses, in m along it; 0: it does not.

    The line of length `far` starts at (x, y) in direction (cos, sin). `body`: see `BODY`.
    """
    dx = body["x"] - x
    dy = body["y"] - y
    along = dx * cos + dy * sin
    if along <= 0.0 or along >= far:
        return 0.0
    turned_cos = abs(body["cos"] * cos + body["sin"] * sin)
    turned_sin = abs(body["sin"] * cos - body["cos"] * sin)
    half_across = body["half_length"] * turned_sin + body["half_width"] * turned_cos
    if abs(dy * cos - dx * sin) >= half_across:
        return 0.0
    half_along = body["half_length"] * turned_cos + body["half_width"] * turned_sin
    return min(float(along + half_along), far)
