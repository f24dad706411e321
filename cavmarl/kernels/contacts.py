"""Who touches whom: oriented boxes that overlap in the plane and in height."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import inlined_kernel, kernel
from cavmarl.kernels.geometry import boxes_overlap
from cavmarl.kernels.neighbors import Grid, cell_columns, cell_rows

__all__ = ["bodies_touch", "find_contacts"]


@inlined_kernel
def bodies_touch(one: np.void, other: np.void) -> bool:
    """Whether two BODY records overlap: their rectangles share area and their heights overlap.

    Vehicles on and under a bridge do not touch: their `z` differ by half the sum of their heights.
    """
    dx = one["x"] - other["x"]
    dy = one["y"] - other["y"]
    reach = one["radius"] + other["radius"]
    if not dx * dx + dy * dy < reach * reach:
        return False
    if not abs(one["z"] - other["z"]) < 0.5 * (one["height"] + other["height"]):
        return False
    return boxes_overlap(
        one["x"],
        one["y"],
        one["cos"],
        one["sin"],
        one["half_length"],
        one["half_width"],
        other["x"],
        other["y"],
        other["cos"],
        other["sin"],
        other["half_length"],
        other["half_width"],
    )


@kernel
def find_contacts(num: int, grid: Grid, hit: NDArray[np.int64]) -> bool:
    """For each vehicle the smallest id of those that it touches; whether any two do.

    Args:
        num: live rows of the world.
        grid: filled for this tick from these rows.
        hit: (C,) by VEHICLE row, overwritten up to `num`: an id, or -1.
    """
    hit[:num] = -1
    found = False
    bodies = grid.bodies
    for a in range(num):
        body = bodies[a]
        reach = body["radius"] + grid.largest[0]
        first_column, last_column = cell_columns(grid, body["x"], reach)
        first_row, last_row = cell_rows(grid, body["y"], reach)
        for j in range(first_row, last_row + 1):
            # Each pair once, from its body that lies further ahead in the array.
            begin = grid.start[j * grid.num_x + first_column]
            end = min(grid.start[j * grid.num_x + last_column + 1], a)
            for b in range(begin, end):
                other = bodies[b]
                if bodies_touch(body, other):
                    _note(hit, body["row"], other["id"])
                    _note(hit, other["row"], body["id"])
                    found = True
    return found


@kernel
def _note(hit: NDArray[np.int64], row: int, vehicle_id: int) -> None:
    """Keep the smallest id seen."""
    if hit[row] < 0 or vehicle_id < hit[row]:
        hit[row] = vehicle_id
