"""The named terms of one agent's step, which reward and evaluation read.

There is one function per term, with common argument names; `write_terms` calls them in the order
of `config.terms.TERMS`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.geometry import time_to_collision_s
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.codes import (
    EVENT_ARRIVED,
    EVENT_COLLIDED,
    EVENT_OFF_ROAD,
    EVENT_RED_LIGHT,
    EVENT_WRONG_WAY,
)
from cavmarl.driving.kernels.emissions import battery_wh, co2_mg_per_s
from cavmarl.driving.kernels.lanes.route_following import free_speed

TTC_HORIZON_S = 4.0  # longer times to collision do not count
TTC_REACH_M = 60.0
TERMS_REACH_M = TTC_REACH_M  # largest distance between centres at which a vehicle changes a term
CIRCLE_MARGIN_M = 0.01  # margin around two circles that do not touch; larger than rounding errors


@kernel
def _progress(row: np.void, step_s: float) -> float:
    """Return the progress towards the goal in m.

    After a wrong turn the new route may be much longer, so progress and loss are limited to twice
    the distance at the current speed (at least 1 m/s).
    """
    if row["step_to_go"] == math.inf:
        return 0.0  # before the step, no route led to the goal
    most = max(row["speed"], 1.0) * step_s * 2.0
    return clamp(row["step_to_go"] - row["to_go"], -most, most)


@kernel
def _speeding(roads: RoadArrays, row: np.void) -> float:
    """Return the excess over the lane's limit, divided by the limit; `delay` covers low speeds."""
    return float(max(row["speed"] / roads.lanes[row["lane"]]["speed_mps"] - 1.0, 0.0))


@kernel
def _jerk(row: np.void, step_s: float) -> float:
    """Return the mean |jerk| over the step in 10 m/s³."""
    discomfort: float = row["step_jerk"] / step_s / 10.0
    return discomfort


@kernel
def _ttc_risk(rows: NDArray[np.void], i: int, grid: Grid) -> float:
    """Return 1 - ttc / TTC_HORIZON_S for the first vehicle hit at constant velocities, or 0.

    Only vehicles whose circumscribed circle could touch the agent's before the horizon are checked.
    """
    row = rows[i]
    cos, sin = cos_sin(row["heading"])
    half_length, half_width = 0.5 * row["length"], 0.5 * row["width"]
    radius = math.sqrt(half_length * half_length + half_width * half_width)
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
            vx = body["speed"] * body["cos"] - row["speed"] * cos
            vy = body["speed"] * body["sin"] - row["speed"] * sin
            apart = radius + body["radius"] + CIRCLE_MARGIN_M
            room = squared - apart * apart
            if room > 0.0:
                # The squared distance decreases by less than 2 · closing per second.
                closing = -(dx * vx + dy * vy)
                across = dx * vy - dy * vx
                if room > 2.0 * least * closing:
                    continue
                if across * across > apart * apart * (vx * vx + vy * vy):
                    continue
            ttc = time_to_collision_s(
                dx,
                dy,
                vx,
                vy,
                cos,
                sin,
                half_length,
                half_width,
                body["cos"],
                body["sin"],
                body["half_length"],
                body["half_width"],
            )
            least = min(least, ttc)
    return 1.0 - least / TTC_HORIZON_S


@kernel
def _event(row: np.void, bit: int) -> float:
    return 1.0 if row["events"] & bit else 0.0


@kernel
def _delay(roads: RoadArrays, kind: np.void, row: np.void, step_s: float) -> float:
    """Return the time lost in s compared with driving at the limit, or at the type's top speed."""
    free_mps = free_speed(roads.lanes[row["lane"]], kind, 1.0)
    return float(step_s * max(1.0 - row["speed"] / free_mps, 0.0))


@kernel
def _energy(kind: np.void, row: np.void, step_s: float) -> float:
    """Return the energy in Wh that an electric car draws in the step; negative: it recuperates."""
    return float(battery_wh(kind["vclass"], row["speed"], row["accel"], row["pitch"], step_s))


@kernel
def _co2(kind: np.void, row: np.void, step_s: float) -> float:
    """Return the CO₂ of a combustion engine in the step in g."""
    rate = co2_mg_per_s(kind["vclass"], row["speed"], row["accel"], row["pitch"])
    return float(1e-3 * step_s * rate)


@kernel
def write_terms(
    roads: RoadArrays,
    rows: NDArray[np.void],  # VEHICLE (C,) at the end of the step
    i: int,  # row of the agent's vehicle
    kind: np.void,  # its VTYPE
    grid: Grid,  # filled from these rows
    step_s: float,  # duration of a step in s
    out: NDArray[np.float32],  # (len(TERMS),) in the order of `config.terms.TERMS`
) -> None:
    row = rows[i]
    out[0] = _progress(row, step_s)
    out[1] = _speeding(roads, row)
    out[2] = _jerk(row, step_s)
    out[3] = _ttc_risk(rows, i, grid)
    out[4] = _event(row, EVENT_COLLIDED)
    out[5] = _event(row, EVENT_OFF_ROAD)
    out[6] = _event(row, EVENT_WRONG_WAY)
    out[7] = _event(row, EVENT_RED_LIGHT)
    out[8] = _event(row, EVENT_ARRIVED)
    out[9] = _delay(roads, kind, row, step_s)
    out[10] = _energy(kind, row, step_s)
    out[11] = _co2(kind, row, step_s)
