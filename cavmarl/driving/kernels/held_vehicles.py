"""Vehicles that are held before a border of their zone, since its other side does not answer."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records import record
from cavmarl.core.records.arrays import RoadArrays, Travel
from cavmarl.driving.kernels.models.following import before_line, response

HELD = record(
    ("vehicle", np.int64),
    ("gap_m", np.float64),  # from its front to the border
)


class HeldVehicles(NamedTuple):
    """Those of k zones of W worlds, in the tick on its way."""

    rows: NDArray[np.void]  # HELD (k, W, C); (k, W, 0) where none is ever held
    counts: NDArray[np.int64]  # (k, W)


def no_held(num_zones: int, num_worlds: int, capacity: int) -> HeldVehicles:
    """Room for `capacity` held vehicles a zone and world, and none in it."""
    return HeldVehicles(
        np.zeros((num_zones, num_worlds, capacity), dtype=HELD),
        np.zeros((num_zones, num_worlds), dtype=np.int64),
    )


@inlined_kernel
def stopping_m(kind: np.void, speed: float) -> float:
    """The way in m on which a driver stops in comfort, its reaction counted in."""
    # IDM, the softest of all models, keeps this distance from what stands.
    soft = 2.0 * math.sqrt(kind["accel"] * kind["decel"])
    return float(kind["min_gap"] + speed * kind["tau"] + speed * speed / soft)


@kernel
def most_accel(
    roads: RoadArrays,
    travel: Travel,
    row: np.void,  # VEHICLE, the committed state
    held: NDArray[np.void],  # HELD, of its zone
    num: int,  # how many there are
    dt: float,  # seconds of a tick
) -> float:
    """The acceleration in m/s² with which a held vehicle stops before the border; others: inf."""
    for n in range(num):
        if held[n]["vehicle"] == row["id"]:
            kind = travel.types[row["vtype"]]
            limit = roads.lanes[row["lane"]]["speed_mps"] * row["speed_factor"]
            allowed = min(limit, kind["max_speed"])
            constraint = before_line(kind, row["speed"], held[n]["gap_m"], dt)
            accel = response(kind, row["speed"], allowed, constraint, 0.0, dt)
            return float(max(accel, -row["speed"] / dt))  # and not back
    return math.inf
