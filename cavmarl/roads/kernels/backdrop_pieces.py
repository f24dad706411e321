"""The static objects of a map (pieces of lanes, buildings), and searches for nearby objects.

Objects are sorted by the cells of the index, so a search always returns them in the same order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.neighbors import Grid, cell_columns, cell_rows
from cavmarl.core.records import record

WALL = record(
    ("ax", np.float64),  # end points a and b, m
    ("ay", np.float64),
    ("bx", np.float64),
    ("by", np.float64),
    ("height", np.float64),  # m above the ground
    ("building", np.int64),
)


class Backdrop(NamedTuple):
    """The static objects of a map in its frame, and the semantic classes of vehicle types.

    Objects are sorted by the cells of their centres; `largest` of a Grid is half of the largest
    extent of an object. Corners of a strip: right start, left start, left end, right end.
    """

    semantics: NDArray[np.uint8]  # (num_types,) semantic class of each VTYPE row
    strips: NDArray[np.float64]  # (num_strips, 4, 2) corners of pieces of lanes
    lined: NDArray[np.float64]  # (num_strips,) 1: the sides of the strip are lane lines; else 0
    strip_index: Grid
    walls: NDArray[np.void]  # WALL (num_walls,)
    wall_index: Grid
    roofs: NDArray[np.float64]  # (num_roofs, 4, 2) corners of convex parts of footprints
    roof_height: NDArray[np.float64]  # (num_roofs,) m above the ground
    roof_index: Grid


@kernel
def gather_walls(
    ego: np.void, walls: NDArray[np.void], index: Grid, reach_m: float, out: NDArray[np.void]
) -> int:
    """Collect the walls around a vehicle, always in the same order.

    `walls`: WALL (num_walls,) in the map frame. `reach_m`: walls farther away are left out.
    `out`: WALL (num_walls,) in the vehicle's frame, overwritten up to the returned number.

    Returns the number of walls.
    """
    cos, sin = cos_sin(ego["heading"])
    far = reach_m + index.largest[0]
    first_column, last_column = cell_columns(index, ego["x"], far)
    first_row, last_row = cell_rows(index, ego["y"], far)
    found = 0
    for j in range(first_row, last_row + 1):
        begin = index.start[j * index.num_x + first_column]
        end = index.start[j * index.num_x + last_column + 1]
        for k in range(begin, end):
            ax = walls[k]["ax"] - ego["x"]
            ay = walls[k]["ay"] - ego["y"]
            bx = walls[k]["bx"] - ego["x"]
            by = walls[k]["by"] - ego["y"]
            if not _comes_near(ax, ay, bx, by, reach_m):
                continue
            wall = out[found]
            wall["ax"] = ax * cos + ay * sin
            wall["ay"] = ay * cos - ax * sin
            wall["bx"] = bx * cos + by * sin
            wall["by"] = by * cos - bx * sin
            wall["height"] = walls[k]["height"]
            wall["building"] = walls[k]["building"]
            found += 1
    return found


@kernel
def _comes_near(ax: float, ay: float, bx: float, by: float, reach_m: float) -> bool:
    """Return whether the segment from a to b comes within `reach_m` of the origin."""
    ex = bx - ax
    ey = by - ay
    squared = ex * ex + ey * ey
    share = 0.0
    if squared > 0.0:
        share = min(max(-(ax * ex + ay * ey) / squared, 0.0), 1.0)
    x = ax + share * ex
    y = ay + share * ey
    return x * x + y * y <= reach_m * reach_m


@kernel
def gather_quads(
    ego: np.void,
    corners: NDArray[np.float64],
    values: NDArray[np.float64],
    index: Grid,
    reach_m: float,
    out_corners: NDArray[np.float64],
    out_values: NDArray[np.float64],
) -> int:
    """Collect the quads around a vehicle, always in the same order; some may be too far away.

    Args:
        ego: VEHICLE record of the observer.
        corners: (num_quads, 4, 2) in the frame of the map.
        values: (num_quads,) an attribute of each quad.
        index: index of the quads by their centres; `largest` is the largest half diagonal.
        reach_m: the result contains all quads with a part within this distance.
        out_corners: (num_quads, 4, 2) in the vehicle's frame, overwritten.
        out_values: (num_quads,) attributes of the collected quads, overwritten.

    Returns:
        The number of quads.
    """
    cos, sin = cos_sin(ego["heading"])
    far = reach_m + index.largest[0]
    first_column, last_column = cell_columns(index, ego["x"], far)
    first_row, last_row = cell_rows(index, ego["y"], far)
    found = 0
    for j in range(first_row, last_row + 1):
        begin = index.start[j * index.num_x + first_column]
        end = index.start[j * index.num_x + last_column + 1]
        for k in range(begin, end):
            x = -ego["x"]
            y = -ego["y"]
            for c in range(4):
                x += 0.25 * corners[k, c, 0]
                y += 0.25 * corners[k, c, 1]
            if x * x + y * y > far * far:
                continue
            for c in range(4):
                x = corners[k, c, 0] - ego["x"]
                y = corners[k, c, 1] - ego["y"]
                out_corners[found, c, 0] = x * cos + y * sin
                out_corners[found, c, 1] = y * cos - x * sin
            out_values[found] = values[k]
            found += 1
    return found
