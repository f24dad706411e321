"""Contacts between vehicles: oriented boxes that overlap in the plane and in height."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import cos_sin, cosine, sine
from cavmarl.core.math.geometry import boxes_overlap
from cavmarl.core.math.neighbors import Grid, cell_at, cell_columns, cell_rows, move_area

APART_M = 1e-6  # tolerance, larger than rounding errors of a distance


@kernel
def _bodies_touch(one: np.void, other: np.void) -> bool:
    """Return whether two VEHICLE records overlap, in the plane and in height.

    Vehicles on and under a bridge do not touch: their `z` differ by at least half the sum of their
    heights.
    """
    cos, sin = cos_sin(one["heading"])
    # Early exit for vehicles on adjacent lanes: compare the lateral distance with an upper bound of
    # both half-widths. The sine of the angle between them is at most the angle.
    turn = abs(one["heading"] - other["heading"])
    reach = 0.5 * (one["width"] + other["width"] + turn * other["length"])
    across = (other["y"] - one["y"]) * cos - (other["x"] - one["x"]) * sin
    if abs(across) > reach + APART_M:
        return False
    if not abs(one["z"] - other["z"]) < 0.5 * (one["height"] + other["height"]):
        return False
    return boxes_overlap(
        one["x"],
        one["y"],
        cos,
        sin,
        0.5 * one["length"],
        0.5 * one["width"],
        other["x"],
        other["y"],
        cosine(other["heading"]),
        sine(other["heading"]),
        0.5 * other["length"],
        0.5 * other["width"],
    )


@kernel
def find_contacts(
    rows: NDArray[np.void],  # VEHICLE (C,)
    num: int,  # live rows of the world; at most the grid's capacity
    grid: Grid,  # `newest` and `spots` are overwritten
    # (C,) for each row the smallest id of the vehicles in contact with it, or -1; overwritten up to
    # `num`
    hit: NDArray[np.int64],
) -> bool:
    """Find the contacts of all vehicles, and return whether there are any.

    In one pass, each vehicle is compared with the vehicles that are already in the grid, and then
    added to the grid.
    """
    grid.newest[:] = -1
    move_area(grid, rows, num)
    largest = 0.0
    found = False
    for i in range(num):
        hit[i] = -1
        row = rows[i]
        half_length = 0.5 * row["length"]
        half_width = 0.5 * row["width"]
        radius = math.sqrt(half_length * half_length + half_width * half_width)
        largest = max(largest, radius)
        spot = grid.spots[i]
        spot["x"] = row["x"]
        spot["y"] = row["y"]
        spot["radius"] = radius
        found |= _touches_earlier(rows, i, spot, radius + largest, grid, hit)
        cell = cell_at(grid, row["x"], row["y"])
        spot["next"] = grid.newest[cell]
        grid.newest[cell] = i
    return found


@inlined_kernel
def _touches_earlier(
    rows: NDArray[np.void], i: int, spot: np.void, reach: float, grid: Grid, hit: NDArray[np.int64]
) -> bool:
    """Write the contacts of row i with vehicles in the grid, and return whether there are any."""
    found = False
    first_column, last_column = cell_columns(grid, spot["x"], reach)
    first_row, last_row = cell_rows(grid, spot["y"], reach)
    for j in range(first_row, last_row + 1):
        for cell in range(j * grid.num_x + first_column, j * grid.num_x + last_column + 1):
            k = grid.newest[cell]
            while k >= 0:
                other = grid.spots[k]
                dx = spot["x"] - other["x"]
                dy = spot["y"] - other["y"]
                near = spot["radius"] + other["radius"]
                if dx * dx + dy * dy < near * near and _bodies_touch(rows[i], rows[k]):
                    _keep_smallest(hit, i, rows[k]["id"])
                    _keep_smallest(hit, k, rows[i]["id"])
                    found = True
                k = other["next"]
    return found


@kernel
def _keep_smallest(hit: NDArray[np.int64], row: int, vehicle_id: int) -> None:
    """Keep the smaller id; -1 means no id."""
    if hit[row] < 0 or vehicle_id < hit[row]:
        hit[row] = vehicle_id
