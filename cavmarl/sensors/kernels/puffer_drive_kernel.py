"""The observation of pufferlib's `drive`: the vehicle, others by id, road segments cell by cell.

Suarez: "PufferLib", ocean environment `drive`, version 3.0: `OWN_FEATURES` numbers of the vehicle,
`PARTNER_FEATURES` for each other one within 50 m and `SEGMENT_FEATURES` for each road segment.
A cell of 5 m holds at most ten segments; a vehicle sees the first ones of the 21 x 21 cells around
its own, in a spiral. What a cell's vehicles see never changes and is listed once, by
`roads.road_segments`. All is float32, as there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.math.scalars import clamp
from cavmarl.core.numba import kernel
from cavmarl.core.records.codes import EVENT_COLLIDED
from cavmarl.sensors.kernels.sensor_arrays import PufferDrive, RoadSegments

__all__ = [
    "CELL_M",
    "MAX_IN_CELL",
    "OWN_FEATURES",
    "PARTNERS_RANGE_M",
    "PARTNER_FEATURES",
    "ROAD_SEGMENT",
    "SEGMENT_FEATURES",
    "SPIRAL_CELLS",
    "list_segments",
    "observe_puffer_drive",
]

OWN_FEATURES = 6
PARTNER_FEATURES = 7
SEGMENT_FEATURES = 7

CELL_M = np.float32(5.0)
MAX_IN_CELL = 10
SPIRAL_CELLS = 21  # a side of the square of cells that are seen

PARTNERS_RANGE_M = 50.0

ROAD_SEGMENT = np.dtype(
    [
        ("x", np.float32),  # middle, m from the map's corner
        ("y", np.float32),
        ("half", np.float32),  # half its length, over 100 m
        ("cos", np.float32),  # direction
        ("sin", np.float32),
        ("type", np.float32),  # 0 lane, 1 line, 2 edge
    ]
)

GOAL_SCALE = 0.005  # 1 / 200 m
SPEED_SCALE = 0.01  # 1 / 100 m/s
NEAR_SCALE = np.float32(0.02)  # 1 / 50 m
WIDTH_SCALE_M = 15.0
LENGTH_SCALE_M = 30.0
SEGMENT_WIDTH = np.float32(0.001)  # 0.1 m of 100 m
ONE = np.float32(1.0)


@kernel
def list_segments(
    start: NDArray[np.int32],
    num_x: int,
    num_y: int,
    spiral: NDArray[np.int64],
    most: int,
    out_start: NDArray[np.int64],
    out: NDArray[np.uint32],
) -> int:
    """For each cell the first segments of the cells around it, in the order of the spiral.

    Args:
        start: (cells + 1,) segments of cell c, c = j * num_x + i: [start[c], start[c + 1]).
        num_x: columns of cells.
        num_y: rows.
        spiral: (n, 2) column and row of each cell seen, less those of the own one.
        most: entries of a list.
        out_start: (cells + 1,) where each cell's list begins in `out`, overwritten.
        out: (cells * most,) room; the lists follow one another without gaps.

    Returns:
        length of all lists together.
    """
    total = 0
    for c in range(num_x * num_y):
        out_start[c] = total
        for k in range(spiral.shape[0]):
            i = c % num_x + spiral[k, 0]
            j = c // num_x + spiral[k, 1]
            if i < 0 or i >= num_x or j < 0 or j >= num_y:
                continue
            near = j * num_x + i
            for segment in range(start[near], start[near + 1]):
                if total - out_start[c] < most:
                    out[total] = segment
                    total += 1
            if total - out_start[c] == most:
                break
    out_start[num_x * num_y] = total
    return total


@kernel
def _partners(row: np.void, i: int, grid: Grid, near_body: NDArray[np.int64]) -> int:
    """Others within range, by id, as positions in `grid.bodies`; returns how many."""
    bodies = grid.bodies
    first_column, last_column = cell_columns(grid, row["x"], PARTNERS_RANGE_M)
    first_row, last_row = cell_rows(grid, row["y"], PARTNERS_RANGE_M)
    found = 0
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = bodies[b]
            dx = body["x"] - row["x"]
            dy = body["y"] - row["y"]
            if (
                not dx * dx + dy * dy <= PARTNERS_RANGE_M * PARTNERS_RANGE_M
                or body["row"] == i
                or abs(body["z"] - row["z"]) > LEVEL_HEIGHT_M
            ):
                continue
            if found < near_body.size:
                found += 1
            elif found == 0 or body["id"] > bodies[near_body[found - 1]]["id"]:
                continue
            place = found - 1
            while place > 0 and body["id"] < bodies[near_body[place - 1]]["id"]:
                near_body[place] = near_body[place - 1]
                place -= 1
            near_body[place] = b
    return found


@kernel
def _seen_from(roads: RoadSegments, x: np.float32, y: np.float32) -> tuple[int, int]:
    """Begin and end in `roads.lists` of what is seen from a place, in m from the map's corner."""
    if not (x >= 0.0 and y >= 0.0):
        return 0, 0
    column = np.int64(x / CELL_M)
    line = np.int64(y / CELL_M)
    if column >= roads.num_x or line >= roads.num_y:
        return 0, 0
    cell = line * roads.num_x + column
    return roads.list_start[cell], roads.list_start[cell + 1]


@kernel
def _unit(value: np.float32) -> np.float32:
    return min(max(value, -ONE), ONE)


@kernel
def _observe_segments(
    roads: RoadSegments,
    x: np.float32,
    y: np.float32,
    cos: np.float32,
    sin: np.float32,
    out: NDArray[np.float32],
) -> None:
    """Write what is seen from a place and, where it is less than there is room for, zeros."""
    begin, end = _seen_from(roads, x, y)
    seen = roads.lists[begin:end]
    segments = roads.segments
    near_cos = cos * NEAR_SCALE
    near_sin = sin * NEAR_SCALE
    for k in range(seen.size):
        segment = segments[seen[k]]
        dx = segment["x"] - x
        dy = segment["y"] - y
        ahead = segment["cos"]
        left = segment["sin"]
        at = SEGMENT_FEATURES * k
        out[at] = dx * near_cos + dy * near_sin
        out[at + 1] = dy * near_cos - dx * near_sin
        out[at + 2] = segment["half"]
        out[at + 3] = SEGMENT_WIDTH
        out[at + 4] = _unit(ahead * cos + left * sin)
        out[at + 5] = _unit(left * cos - ahead * sin)
        out[at + 6] = segment["type"]
    out[SEGMENT_FEATURES * seen.size :] = 0.0


@kernel
def _observe_own(row: np.void, goal: NDArray[np.float64], out: NDArray[np.float32]) -> None:
    """Write where the goal is, how fast and large the vehicle is, and whether it has collided."""
    cos = math.cos(row["heading"])
    sin = math.sin(row["heading"])
    goal_x = goal[0] - row["x"]
    goal_y = goal[1] - row["y"]
    out[0] = (goal_x * cos + goal_y * sin) * GOAL_SCALE
    out[1] = (goal_y * cos - goal_x * sin) * GOAL_SCALE
    out[2] = abs(row["speed"]) * SPEED_SCALE
    out[3] = row["width"] / WIDTH_SCALE_M
    out[4] = row["length"] / LENGTH_SCALE_M
    out[5] = 1.0 if row["events"] & EVENT_COLLIDED != 0 else 0.0


@kernel
def _observe_partners(
    rows: NDArray[np.void],
    i: int,
    grid: Grid,
    near_body: NDArray[np.int64],
    out: NDArray[np.float32],
) -> None:
    """Write others by id and, where they are fewer than there is room for, zeros."""
    row = rows[i]
    cos = math.cos(row["heading"])
    sin = math.sin(row["heading"])
    found = _partners(row, i, grid, near_body)
    for k in range(found):
        other = grid.bodies[near_body[k]]
        dx = other["x"] - row["x"]
        dy = other["y"] - row["y"]
        at = PARTNER_FEATURES * k
        out[at] = (dx * cos + dy * sin) * NEAR_SCALE
        out[at + 1] = (dy * cos - dx * sin) * NEAR_SCALE
        out[at + 2] = 2.0 * other["half_width"] / WIDTH_SCALE_M
        out[at + 3] = 2.0 * other["half_length"] / LENGTH_SCALE_M
        out[at + 4] = clamp(other["cos"] * cos + other["sin"] * sin, -1.0, 1.0)
        out[at + 5] = clamp(other["sin"] * cos - other["cos"] * sin, -1.0, 1.0)
        out[at + 6] = abs(other["speed"]) * SPEED_SCALE
    out[PARTNER_FEATURES * found :] = 0.0


@kernel
def observe_puffer_drive(
    rows: NDArray[np.void], i: int, grid: Grid, sensor: PufferDrive, out: NDArray[np.float32]
) -> None:
    """Write the whole observation of one vehicle, its zeros too.

    Args:
        rows: VEHICLE (C,).
        i: the row that looks.
        grid: filled for this tick.
        sensor: settings, segments and room.
        out: an observation, overwritten from `sensor.at` to its end.
    """
    row = rows[i]
    roads = sensor.roads
    partners_at = sensor.at + OWN_FEATURES
    segments_at = partners_at + PARTNER_FEATURES * sensor.near_body.size
    _observe_own(row, sensor.destinations[row["goal"]], out[sensor.at : partners_at])
    _observe_partners(rows, i, grid, sensor.near_body, out[partners_at:segments_at])
    _observe_segments(
        roads,
        np.float32(row["x"] - roads.min_x),
        np.float32(row["y"] - roads.min_y),
        np.float32(math.cos(row["heading"])),
        np.float32(math.sin(row["heading"])),
        out[segments_at:],
    )
