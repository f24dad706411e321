"""Cooperative braking: followers on the target lane slow down for a vehicle that has to merge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.driving.kernels.lanes.lane_choice import LOOK_BACK_M, SIDE_GAP_M
from cavmarl.driving.kernels.lanes.lane_index import behind_by, beside_s
from cavmarl.driving.kernels.models.following import accel_behind

COOPERATIVE_DECEL = 3.0  # m/s², largest deceleration to let a vehicle merge or to follow a leader


@kernel
def brake_for_merging(
    roads: RoadArrays, travel: TripTables, rows: NDArray[np.void], row: np.void, scratch: Scratch
) -> None:
    """Slow down the follower on the lane to which a vehicle has to change.

    If that lane is free behind the vehicle, slow down the next follower on each lane that leads to
    it.
    """
    lane = roads.lanes[row["lane"]]
    target = lane["left"] if row["blinker"] > 0 else lane["right"]
    if target < 0:
        return
    s = beside_s(roads, row["lane"], target, row["s"])
    for n in range(max(1, roads.lanes[target]["num_into"])):
        k, apart = behind_by(roads, scratch, target, s, row["id"], n, LOOK_BACK_M, travel.view_m)
        if k >= 0:
            _brake_follower(roads, travel, rows, row, target, k, apart, scratch)


@kernel
def _brake_follower(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    row: np.void,
    target: int,
    k: int,
    apart: float,
    scratch: Scratch,
) -> None:
    """Slow down the follower of entry `k`, `apart` m behind `row`, which changes to `target`."""
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
    scratch.accel[i] = min(scratch.accel[i], max(accel, -COOPERATIVE_DECEL))
