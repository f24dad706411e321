"""A grid with the vehicles of one world in square cells, and searches for nearby vehicles.

`fill_grid` sorts the vehicles into cells once per tick. It copies the data that neighbours read
into `bodies`: compact records with sine and cosine of the heading computed once. Within a cell,
bodies are in row order; readers must not depend on this order, and break ties by id.

The border cells extend to infinity: they contain everything outside of the grid's area. If each
world has one of several maps, the area floats: it begins where the vehicles of the world are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin

LEVEL_HEIGHT_M = (
    4.0  # vehicles further apart in z are on different levels and do not see each other
)

# Added to every search, so that a body at exactly the search distance is always found.
_MARGIN_M = 1e-6

BODY = np.dtype(
    [
        ("id", np.int64),
        ("row", np.int64),  # VEHICLE row
        ("x", np.float64),  # centre, m
        ("y", np.float64),
        ("z", np.float64),
        ("cos", np.float64),  # cosine of the heading
        ("sin", np.float64),
        ("speed", np.float64),  # m/s
        ("half_length", np.float64),  # m
        ("half_width", np.float64),
        ("height", np.float64),
        ("radius", np.float64),  # half the diagonal, m
    ],
    align=True,
)

SPOT = np.dtype(
    [
        ("x", np.float64),  # centre, m
        ("y", np.float64),
        ("radius", np.float64),  # half the diagonal, m
        ("next", np.int32),  # VEHICLE row of another vehicle in the same cell, or -1
    ],
    align=True,
)


class Grid(NamedTuple):
    """Square cells over a map and the bodies in them; rebuilt in each tick."""

    corner: NDArray[np.float64]  # (2,) m, corner of cell (0, 0)
    floating: bool  # whether `move_area` moves the area
    cells_per_m: float
    num_x: int
    num_y: int
    start: NDArray[
        np.int32
    ]  # (num_x * num_y + 1,) cell (i, j) has bodies[start[c] : start[c + 1]],
    bodies: NDArray[np.void]  # BODY (capacity,)             c = j * num_x + i
    cell: NDArray[np.int32]  # (capacity,) the cell of each row
    largest: NDArray[np.float64]  # (1,) the largest radius of all bodies, m
    newest: NDArray[np.int32]  # (num_x * num_y,) the VEHICLE row last put into each cell, or -1
    spots: NDArray[np.void]  # SPOT (capacity,) by VEHICLE row; only `contacts` uses this and newest


def make_grid(
    bounds: tuple[float, float, float, float],  # min_x, min_y, max_x, max_y of the area in m
    cell_m: float,  # side of a cell in m; about half the usual search distance is fast
    capacity: int,  # maximum number of vehicles
    floating: bool = False,  # whether the area begins where the vehicles are
) -> Grid:
    """Return an empty grid."""
    min_x, min_y, max_x, max_y = bounds
    num_x = max(1, math.ceil((max_x - min_x) / cell_m))
    num_y = max(1, math.ceil((max_y - min_y) / cell_m))
    return Grid(
        corner=np.array([min_x, min_y], dtype=np.float64),
        floating=floating,
        cells_per_m=1.0 / float(cell_m),
        num_x=num_x,
        num_y=num_y,
        start=np.zeros(num_x * num_y + 1, np.int32),
        bodies=np.zeros(capacity, BODY),
        cell=np.zeros(capacity, np.int32),
        largest=np.zeros(1),
        newest=np.zeros(num_x * num_y, np.int32),
        spots=np.zeros(capacity, SPOT),
    )


@kernel
def _slot(offset: float, cells_per_m: float, count: int) -> int:
    """Return the cell along one axis; the border cell if outside, the first cell for NaN."""
    cells = offset * cells_per_m
    cells = cells if cells > 0.0 else 0.0  # also for NaN
    last = count - 1.0
    return int(cells if cells < last else last)


@kernel
def cell_at(grid: Grid, x: float, y: float) -> int:
    column = _slot(x - grid.corner[0], grid.cells_per_m, grid.num_x)
    return _slot(y - grid.corner[1], grid.cells_per_m, grid.num_y) * grid.num_x + column


@kernel
def cell_columns(grid: Grid, x: float, distance_m: float) -> tuple[int, int]:
    """Return the first and last column of cells with bodies within `distance_m` of `x`."""
    return (
        _slot(x - distance_m - _MARGIN_M - grid.corner[0], grid.cells_per_m, grid.num_x),
        _slot(x + distance_m + _MARGIN_M - grid.corner[0], grid.cells_per_m, grid.num_x),
    )


@kernel
def cell_rows(grid: Grid, y: float, distance_m: float) -> tuple[int, int]:
    """Return the first and last row of cells with bodies within `distance_m` of `y`."""
    return (
        _slot(y - distance_m - _MARGIN_M - grid.corner[1], grid.cells_per_m, grid.num_y),
        _slot(y + distance_m + _MARGIN_M - grid.corner[1], grid.cells_per_m, grid.num_y),
    )


@kernel
def move_area(grid: Grid, rows: NDArray[np.void], num: int) -> None:
    """Let a floating grid begin at the smallest x and the smallest y of VEHICLE rows[:num]."""
    if not grid.floating or num == 0:
        return
    min_x = math.inf
    min_y = math.inf
    for i in range(num):
        min_x = min(min_x, rows[i]["x"])
        min_y = min(min_y, rows[i]["y"])
    grid.corner[0] = min_x
    grid.corner[1] = min_y


@kernel
def _fill_body(body: np.void, vehicle: np.void, row: int) -> None:
    """Copy the data of a vehicle that neighbours read."""
    half_length = 0.5 * vehicle["length"]
    half_width = 0.5 * vehicle["width"]
    heading = vehicle["heading"]
    cos, sin = cos_sin(heading)
    body["id"] = vehicle["id"]
    body["row"] = row
    body["x"] = vehicle["x"]
    body["y"] = vehicle["y"]
    body["z"] = vehicle["z"]
    body["cos"] = cos
    body["sin"] = sin
    body["speed"] = vehicle["speed"]
    body["half_length"] = half_length
    body["half_width"] = half_width
    body["height"] = vehicle["height"]
    body["radius"] = math.sqrt(half_length * half_length + half_width * half_width)


@kernel
def fill_grid(
    rows: NDArray[np.void],  # VEHICLE (C,)
    num: int,  # live rows, `rows[:num]`; at most the grid's capacity
    grid: Grid,  # overwritten
) -> None:
    """Sort the vehicles of one world into the cells of `grid`, replacing its content."""
    start = grid.start
    cell = grid.cell
    start[:] = 0
    move_area(grid, rows, num)
    for i in range(num):
        c = cell_at(grid, rows[i]["x"], rows[i]["y"])
        cell[i] = c
        start[c] += 1
    for c in range(1, start.size):
        start[c] += start[c - 1]
    # Cells are filled from their ends, so rows are visited from last to first.
    largest = 0.0
    for i in range(num - 1, -1, -1):
        c = cell[i]
        start[c] -= 1
        body = grid.bodies[start[c]]
        _fill_body(body, rows[i], i)
        largest = max(largest, body["radius"])
    grid.largest[0] = largest


@kernel
def nearest_bodies(
    grid: Grid,  # filled for this tick
    row: int,  # VEHICLE row to leave out, the searching vehicle; -1: none
    x: float,  # m
    y: float,  # m
    z: float,  # m; vehicles more than `LEVEL_HEIGHT_M` above or below are left out
    radius_m: float,  # maximum distance of centres in the plane
    k: int,  # maximum number of vehicles
    # (k,) int, positions in `grid.bodies`, overwritten up to the returned number
    out_body: NDArray[np.int32],
    out_squared: NDArray[np.float64],  # (k,) their squared distances in m²
) -> int:  # number of vehicles found
    """Return the nearest vehicles on the same level, sorted by distance, then by id."""
    bodies = grid.bodies
    limit = radius_m * radius_m
    first_column, last_column = cell_columns(grid, x, radius_m)
    first_row, last_row = cell_rows(grid, y, radius_m)
    found = 0
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = bodies[b]
            dx = body["x"] - x
            dy = body["y"] - y
            squared = dx * dx + dy * dy
            if not squared <= limit or body["row"] == row or abs(body["z"] - z) > LEVEL_HEIGHT_M:
                continue
            # Insertion sort from the end.
            place = found
            while place > 0 and (
                squared < out_squared[place - 1]
                or (
                    squared == out_squared[place - 1]
                    and body["id"] < bodies[out_body[place - 1]]["id"]
                )
            ):
                place -= 1
            if place == k:
                continue
            if found < k:
                found += 1
            for m in range(found - 1, place, -1):
                out_body[m] = out_body[m - 1]
                out_squared[m] = out_squared[m - 1]
            out_body[place] = b
            out_squared[place] = squared
    return found
