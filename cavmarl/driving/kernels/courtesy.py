"""Courtesy: followers on the target lane make room for a vehicle that has to change lanes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, Travel
from cavmarl.driving.kernels.following import accel_behind
from cavmarl.driving.kernels.lane_choice import LOOK_BACK_M, SIDE_GAP_M
from cavmarl.driving.kernels.lane_index import behind_by, beside_s

COURTESY_DECEL = 3.0  # m/s², the hardest braking to let a vehicle merge, or to fall in behind


@kernel
def let_merge(
    roads: RoadArrays, travel: Travel, rows: NDArray[np.void], row: np.void, scratch: Scratch
) -> None:
    """Slow down the follower on the lane that a vehicle needs to change to.

    Where that lane is free behind it, these are the next ones on all lanes that lead there.
    """
    lane = roads.lanes[row["lane"]]
    target = lane["left"] if row["blinker"] > 0 else lane["right"]
    if target < 0:
        return
    s = beside_s(roads, row["lane"], target, row["s"])
    for n in range(max(1, roads.lanes[target]["num_into"])):
        k, apart = behind_by(roads, scratch, target, s, row["id"], n, LOOK_BACK_M, travel.view_m)
        if k >= 0:
            _soften(roads, travel, rows, row, target, k, apart, scratch)


@kernel
def _soften(
    roads: RoadArrays,
    travel: Travel,
    rows: NDArray[np.void],
    row: np.void,
    target: int,
    k: int,
    apart: float,
    scratch: Scratch,
) -> None:
    """Soften the way of a follower, an entry so far behind `row` on its way to lane `target`."""
    follower = scratch.entries[k]
    gap = apart - 0.5 * row["length"] - follower["half"]
    if follower["side"] or gap < SIDE_GAP_M or apart > LOOK_BACK_M:
        return
    other = rows[follower["row"]]
    kind = travel.types[other["vtype"]]
    desired = roads.lanes[target]["speed_mps"] * other["speed_factor"]
    decel = travel.types[row["vtype"]]["decel"]
    accel = accel_behind(kind, follower["speed"], desired, gap, row["speed"], decel)
    i = follower["row"]
    scratch.accel[i] = min(scratch.accel[i], max(accel, -COURTESY_DECEL))
