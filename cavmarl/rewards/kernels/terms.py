"""The named terms of one agent's step. Reward and evaluation read the same numbers.

One function a term, all with the same arguments' names; `write_terms` calls them in the order of
`config.TERMS`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.math.scalars import clamp
from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.codes import (
    EVENT_ARRIVED,
    EVENT_COLLIDED,
    EVENT_OFF_ROAD,
    EVENT_RED_LIGHT,
    EVENT_WRONG_WAY,
)

NUM_TERMS = 10
TTC_HORIZON_S = 4.0  # times to collision above this do not count
TTC_REACH_M = 60.0
TTC_WIDTH_M = 2.2  # two vehicles that would pass further apart than this do not collide


@kernel
def _progress(row: np.void, step_s: float) -> float:
    """Way towards the goal in m.

    A new plan after a wrong turn may be longer by far: that counts as no more than driving back.
    """
    if row["step_to_go"] == math.inf:
        return 0.0  # it came from where no way led to its goal
    most = max(row["speed"], 1.0) * step_s * 2.0
    return clamp(row["step_to_go"] - row["to_go"], -most, most)


@kernel
def _of_limit(roads: RoadArrays, row: np.void) -> float:
    ratio: float = row["speed"] / roads.lanes[row["lane"]]["speed_mps"]
    return ratio


@kernel
def _speed(roads: RoadArrays, row: np.void) -> float:
    """Speed above the lane's limit, as a share of it; what is lost below it is `delay`."""
    return max(_of_limit(roads, row) - 1.0, 0.0)


@kernel
def _comfort(row: np.void, step_s: float) -> float:
    """Mean |jerk| over the step in 10 m/s³."""
    discomfort: float = row["step_jerk"] / step_s / 10.0
    return discomfort


@kernel
def _time_to_collision(rows: NDArray[np.void], i: int, grid: Grid) -> float:
    """1 - ttc / TTC_HORIZON_S for the vehicle that would be hit first at constant velocities, or 0.

    Vehicles count as discs: `ttc` is when the distance of centres falls to the two half lengths, if
    their paths come within `TTC_WIDTH_M` (Hayward 1972, in the plane).
    """
    row = rows[i]
    vx = row["speed"] * math.cos(row["heading"])
    vy = row["speed"] * math.sin(row["heading"])
    least = TTC_HORIZON_S
    first_column, last_column = cell_columns(grid, row["x"], TTC_REACH_M)
    first_row, last_row = cell_rows(grid, row["y"], TTC_REACH_M)
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = grid.bodies[b]
            dx = body["x"] - row["x"]
            dy = body["y"] - row["y"]
            squared = dx * dx + dy * dy
            if body["row"] == i or squared > TTC_REACH_M * TTC_REACH_M:
                continue
            if abs(body["z"] - row["z"]) > LEVEL_HEIGHT_M:
                continue
            wx = body["speed"] * body["cos"] - vx
            wy = body["speed"] * body["sin"] - vy
            closing = -(dx * wx + dy * wy)
            speed_squared = wx * wx + wy * wy
            if closing <= 0.0 or speed_squared < 1e-6:
                continue
            if abs(dx * wy - dy * wx) > TTC_WIDTH_M * math.sqrt(speed_squared):
                continue
            distance = math.sqrt(squared)
            gap = max(distance - body["half_length"] - 0.5 * row["length"], 0.0)
            least = min(least, gap * distance / closing)
    return 1.0 - least / TTC_HORIZON_S


@kernel
def _event(row: np.void, bit: int) -> float:
    return 1.0 if row["events"] & bit else 0.0


@kernel
def _delay(roads: RoadArrays, row: np.void, step_s: float) -> float:
    """Time lost against driving at the limit, in s."""
    return step_s * max(1.0 - _of_limit(roads, row), 0.0)


@kernel
def write_terms(
    roads: RoadArrays,
    rows: NDArray[np.void],  # VEHICLE (C,) at the end of the step
    i: int,  # row of the agent's vehicle
    grid: Grid,  # filled from these rows
    step_s: float,  # seconds a step
    out: NDArray[np.float32],  # (NUM_TERMS,) in the order of `config.TERMS`
) -> None:
    row = rows[i]
    out[0] = _progress(row, step_s)
    out[1] = _speed(roads, row)
    out[2] = _comfort(row, step_s)
    out[3] = _time_to_collision(rows, i, grid)
    out[4] = _event(row, EVENT_COLLIDED)
    out[5] = _event(row, EVENT_OFF_ROAD)
    out[6] = _event(row, EVENT_WRONG_WAY)
    out[7] = _event(row, EVENT_RED_LIGHT)
    out[8] = _event(row, EVENT_ARRIVED)
    out[9] = _delay(roads, row, step_s)
