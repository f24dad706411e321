"""Which lane a driver wants, for its way or to drive faster, and whether it may change now.

The question is MOBIL's (`lane_change`); this file finds whom it concerns, and when a way needs it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import RoadArrays, Scratch
from cavmarl.kernels.car_following import ACCEL_MAX, idm_free
from cavmarl.kernels.codes import DRIVER_AGENT
from cavmarl.kernels.following import accel_behind
from cavmarl.kernels.lane_change import LANE_CHANGE_DELAY_S, mobil_accepts
from cavmarl.kernels.lanes import last_on_lane, neighbor_ahead, neighbor_behind

__all__ = ["LOOK_BACK_M", "SIDE_GAP_M", "choose_lane", "needed_change"]

LOOK_BACK_M = 60.0  # how far back a lane change looks for followers
CHANGE_EARLY_M = 80.0  # a change that the route needs is made this far before it must be,
CHANGE_EARLY_S = 12.0  # plus the way of this time
MAX_BRAKING_ACCEPTED = 4.0  # m/s², harder braking behind the new leader is never worth it
SIDEWAYS_S = 2.5  # a lane change takes about this long, and has to end before the lane does
BRAKE_TIME_S = 0.5  # a braking that ends within this time is not felt
SIDE_GAP_M = 1.0  # m between bumpers, the least with which a lane change starts


@kernel
def needed_change(roads: RoadArrays, plans: NDArray[np.void], row: np.void) -> int:
    """The side that a vehicle's way needs it to change to by now: 1 left, -1 right, 0 none."""
    step = plans[row["goal"], row["lane"]]
    if step["change"] == 0 or roads.lanes[row["lane"]]["internal"]:
        return 0
    early = (CHANGE_EARLY_M + CHANGE_EARLY_S * row["speed"]) * step["changes"]
    return int(step["change"]) if step["room"] - row["s"] <= early else 0


@kernel
def _change_is_safe(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    target: int,
    accel: float,
    mandatory: bool,
    scratch: Scratch,
) -> bool:
    """MOBIL's question for row i and lane `target`, with the gaps that it takes for granted."""
    row = rows[i]
    s = row["s"] * roads.lanes[target]["length_m"] / roads.lanes[row["lane"]]["length_m"]
    desired = roads.lanes[target]["speed_mps"] * row["speed_factor"]
    after = idm_free(row["speed"], desired, ACCEL_MAX)
    j, ahead_s = neighbor_ahead(rows, i, target, s, scratch)
    ahead = ahead_s - s
    beyond = plans[row["goal"], target]["next"]
    if j < 0 and beyond >= 0:
        j, ahead_s = last_on_lane(i, beyond, scratch)
        ahead = ahead_s + roads.lanes[target]["length_m"] - s
    if j >= 0:
        if ahead < 0.5 * (row["length"] + rows[j]["length"]) + SIDE_GAP_M:
            return False
        after = accel_behind(row, desired, ahead, rows[j])
    follower_before = 0.0
    follower_after = 0.0
    k, gap = neighbor_behind(roads, rows, i, target, s, LOOK_BACK_M, scratch)
    if k >= 0:
        follower = rows[k]
        if gap < 0.5 * (row["length"] + follower["length"]) + SIDE_GAP_M:
            return False
        limit = roads.lanes[target]["speed_mps"] * follower["speed_factor"]
        follower_before = idm_free(follower["speed"], limit, ACCEL_MAX)
        if j >= 0:
            follower_before = accel_behind(follower, limit, gap + ahead, rows[j])
        follower_after = accel_behind(follower, limit, gap, row)
        # Who stands or creeps cannot brake for long, whatever the model answers at short distances.
        follower_after = max(follower_after, -follower["speed"] / BRAKE_TIME_S)
    after = max(after, -row["speed"] / BRAKE_TIME_S)
    if after < -MAX_BRAKING_ACCEPTED:
        return False
    return mobil_accepts(accel, after, follower_before, follower_after, 0.0, 0.0, mandatory)


@kernel
def _may_change(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    side: int,
    needed: int,
    accel: float,
    scratch: Scratch,
) -> bool:
    """Whether row i wants to and can change to one side: for its way, or to drive faster."""
    row = rows[i]
    lane = roads.lanes[row["lane"]]
    target = lane["left"] if side > 0 else lane["right"]
    if lane["internal"] or target < 0 or (needed != 0 and needed != side):
        return False
    if lane["length_m"] - row["s"] < 0.5 * row["length"] + SIDEWAYS_S * row["speed"]:
        return False
    if needed == 0:
        beyond = plans[row["goal"], target]
        if beyond["to_go"] == math.inf or row["speed"] < 1.0:
            return False
        early = (CHANGE_EARLY_M + CHANGE_EARLY_S * row["speed"]) * beyond["changes"]
        if beyond["change"] != 0 and beyond["room"] - row["s"] < 2.0 * early:
            return False
    return _change_is_safe(roads, plans, rows, i, target, accel, needed != 0, scratch)


@kernel
def choose_lane(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    tick: int,
    dt: float,
    needed: int,
    accel: float,
    scratch: Scratch,
) -> int:
    """The lane change that row i makes now: 1 left, -1 right, 0 none.

    In even ticks background drivers may only change to the left, in odd ones to the right: two of
    them never take the same gap from both sides in one tick, whoever is asked first. A suggestion
    for an agent is made anew at each step and binds nobody, so it has no such rule.
    """
    row = rows[i]
    if row["driver"] == DRIVER_AGENT:
        for side in (1, -1):
            if _may_change(roads, plans, rows, i, side, needed, accel, scratch):
                return side
        return 0
    # Every driver thinks of either side once in LANE_CHANGE_DELAY_S, not all in the same ticks.
    turns = max(1, round(0.5 * LANE_CHANGE_DELAY_S / dt))
    if row["side_lane"] >= 0 or (tick // 2 + row["id"]) % turns != 0:
        return 0
    side = 1 if tick % 2 == 0 else -1
    if _may_change(roads, plans, rows, i, side, needed, accel, scratch):
        return side
    return 0
