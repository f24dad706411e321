"""Background drivers: what each wants to do in this tick, from the committed state alone.

Car following is the Intelligent Driver Model, lane changing MOBIL; this file finds what they are
applied to: the leader across lane and junction borders, the lower speed limit ahead, the stop line
of a signal or of a right of way, the end of a lane, the vehicle that wants to merge, the lane that
the route needs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import RoadArrays, Scratch
from cavmarl.kernels.car_following import (
    ACCEL_LIMIT,
    ACCEL_MAX,
    DECEL_COMFORT,
    JAM_DISTANCE_M,
    TIME_HEADWAY_S,
    idm_free,
    idm_interaction,
)
from cavmarl.kernels.codes import DRIVER_AGENT, HOLD_NONE
from cavmarl.kernels.junctions import conflict_inside, may_enter
from cavmarl.kernels.lane_change import mobil_accepts
from cavmarl.kernels.lanes import last_on_lane, neighbor_ahead, neighbor_behind
from cavmarl.kernels.scalars import clamp

__all__ = ["LOOK_AHEAD_M", "decide", "needed_change"]

LOOK_AHEAD_M = 250.0  # no driver looks further
LOOK_BACK_M = 60.0  # how far back a lane change looks for followers
REFERENCE_LENGTH_M = 5.0  # JAM_DISTANCE_M is measured between centres of cars of this length
LINE_MARGIN_M = 1.0  # a driver stops with its front this far before a line
STOP_LINE_M = 5.0  # standing with the front nearer than this counts as standing at the line
LIMIT_DECEL = 2.0  # m/s², how a driver slows for a lower limit ahead,
LIMIT_LEAD_S = 1.0  # to be down this time before it, as the model lags behind what is allowed
SHARED_START_M = 7.0  # two links from one lane share about this much of their way
COURTESY_DECEL = 2.0  # m/s², the hardest braking to let somebody merge
DECIDE_EVERY_TICKS = 10  # how often a driver thinks of changing to one side
CHANGE_EARLY_M = 80.0  # a change that the route needs is made this far before it must be,
CHANGE_EARLY_S = 12.0  # plus the way of this time
# A driver that has to leave a lane waits this far before its end to change right, twice as far to
# change left: two that want to swap lanes do not stand side by side for ever.
MERGE_ROOM_M = 10.0
MERGE_ROOM_SHARE = 0.25  # at most this share of the lane's length
LATERAL_ACCEL = 2.5  # m/s², with which a steered car takes a bend: where a lane turns
MIN_BEND_RAD = 0.2  # by more than this
BEND_M = 6.0  # within this length
MAX_BRAKING_ACCEPTED = 4.0  # m/s², harder braking behind the new leader is never worth it
SIDEWAYS_S = 2.5  # a lane change takes about this long, and has to end before the lane does
BRAKE_TIME_S = 0.5  # a braking that ends within this time is not felt
SIDE_GAP_M = 1.0  # m between bumpers, the least with which a lane change starts


@kernel
def _behind(row: np.void, distance: float, other: np.void) -> float:
    """IDM's interaction with a leader whose centre is `distance` m ahead."""
    net = distance - 0.5 * (row["length"] + other["length"])
    return idm_interaction(
        row["speed"],
        max(net, 0.1) + REFERENCE_LENGTH_M,
        other["speed"],
        ACCEL_MAX,
        DECEL_COMFORT,
        JAM_DISTANCE_M,
        TIME_HEADWAY_S,
    )


@kernel
def _before_line(row: np.void, distance: float) -> float:
    """IDM's interaction with a line `distance` m ahead of the vehicle's front."""
    return idm_interaction(
        row["speed"],
        max(distance - LINE_MARGIN_M, 0.1 - JAM_DISTANCE_M + REFERENCE_LENGTH_M) + JAM_DISTANCE_M,
        0.0,
        ACCEL_MAX,
        DECEL_COMFORT,
        JAM_DISTANCE_M,
        TIME_HEADWAY_S,
    )


@kernel
def _look_ahead_m(speed: float) -> float:
    return min(30.0 + 2.0 * speed + 0.2 * speed * speed, LOOK_AHEAD_M)


@kernel
def _bend_speed(roads: RoadArrays, lane: int, distance: float) -> float:
    """The speed in m/s, now, with which a steered car can take all bends of a lane in comfort.

    `distance` is the way to the start of the lane in m, negative on it.
    """
    row = roads.lanes[lane]
    first = row["first_point"]
    last = first + row["num_points"] - 1
    slowest = math.inf
    for k in range(first + 1, last):
        to_bend = distance + roads.points[k]["s"]
        if to_bend < -BEND_M:
            continue
        before = roads.points[k - 1]
        m = k
        while m < last - 1 and roads.points[m + 1]["s"] - roads.points[k]["s"] < BEND_M:
            m += 1
        after = roads.points[m]
        bend = abs(
            math.atan2(
                before["cos"] * after["sin"] - before["sin"] * after["cos"],
                before["cos"] * after["cos"] + before["sin"] * after["sin"],
            )
        )
        if bend > MIN_BEND_RAD:
            squared = LATERAL_ACCEL * BEND_M / bend + 2.0 * LIMIT_DECEL * max(to_bend, 0.0)
            slowest = min(slowest, math.sqrt(squared))
    return slowest


@kernel
def _shared_start(
    roads: RoadArrays,
    rows: NDArray[np.void],
    row: np.void,
    lane: int,
    chosen: int,
    distance: float,
    scratch: Scratch,
) -> float:
    """Interaction with vehicles that have just turned off from the same lane into another link."""
    strongest = 0.0
    first = roads.lanes[lane]["first_link"]
    for link in range(first, first + roads.lanes[lane]["num_links"]):
        if link == chosen:
            continue
        for k in range(scratch.link_start[link], scratch.link_start[link + 1]):
            other = rows[scratch.link_row[k]]
            place = -scratch.link_dist[k]
            if place > 0.0 and place - 0.5 * other["length"] < SHARED_START_M:
                strongest = max(strongest, _behind(row, distance + place, other))
    return strongest


@kernel
def _road_ahead(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    phase: NDArray[np.int32],
    merge_room_m: float,
    scratch: Scratch,
) -> tuple[float, float, int, int]:
    """Walk row i's way: (strongest interaction, allowed speed, why it holds, link near its line).

    Before the end of a lane that its way does not follow it stops `merge_room_m` early.
    """
    row = rows[i]
    lane = row["lane"]
    half = 0.5 * row["length"]
    strongest = 0.0
    allowed = roads.lanes[lane]["speed_mps"] * row["speed_factor"]
    if row["driver"] == DRIVER_AGENT:
        allowed = min(allowed, _bend_speed(roads, lane, -row["s"]))
    look = _look_ahead_m(row["speed"])
    distance = -row["s"]
    hold = HOLD_NONE
    link_ahead = -1
    j, s = neighbor_ahead(rows, i, lane, row["s"], scratch)
    if roads.lanes[lane]["internal"]:
        link = roads.lanes[lane]["link"]
        place = roads.lanes[lane]["link_offset_m"] + row["s"]
        to_foe = conflict_inside(roads, rows, i, link, place, scratch)
        if to_foe < math.inf:
            strongest = _before_line(row, to_foe)
    while True:
        if j >= 0:
            strongest = max(strongest, _behind(row, distance + s, rows[j]))
            break
        distance += roads.lanes[lane]["length_m"]
        if distance > look:
            break
        step = plans[row["goal"], lane]
        if step["next"] < 0:
            if step["to_go"] == math.inf or step["change"] != 0:
                # Stop with room enough to swing out, but on this lane and not before it.
                length = roads.lanes[lane]["length_m"]
                room = merge_room_m if step["change"] < 0 else 2.0 * merge_room_m
                room = min(room, MERGE_ROOM_SHARE * length)
                place = max(length - half - room, min(2.0 * LINE_MARGIN_M, 0.5 * length))
                strongest = max(strongest, _before_line(row, distance - length + place))
            break
        if step["link"] >= 0:
            if distance - half < STOP_LINE_M and link_ahead < 0:
                link_ahead = step["link"]
            hold = may_enter(roads, rows, i, step["link"], distance, phase, scratch)
            if hold != HOLD_NONE:
                strongest = max(strongest, _before_line(row, distance - half))
                break
            shared = _shared_start(roads, rows, row, lane, step["link"], distance, scratch)
            strongest = max(strongest, shared)
        lane = step["next"]
        limit = roads.lanes[lane]["speed_mps"] * row["speed_factor"]
        if row["driver"] == DRIVER_AGENT:
            allowed = min(allowed, _bend_speed(roads, lane, distance))
        slowing = max(distance - LIMIT_LEAD_S * row["speed"], 0.0)
        allowed = min(allowed, math.sqrt(limit * limit + 2.0 * LIMIT_DECEL * slowing))
        j, s = last_on_lane(i, lane, scratch)
    return strongest, allowed, hold, link_ahead


@kernel
def _courtesy(roads: RoadArrays, rows: NDArray[np.void], i: int, scratch: Scratch) -> float:
    """Interaction with vehicles on neighbour lanes that need to come into ours, softly."""
    row = rows[i]
    strongest = 0.0
    for side in (1, -1):
        beside = roads.lanes[row["lane"]]["left"] if side > 0 else roads.lanes[row["lane"]]["right"]
        if beside < 0:
            continue
        j, s = neighbor_ahead(rows, i, beside, row["s"], scratch)
        if j < 0 or rows[j]["blinker"] != -side or rows[j]["lane"] != beside:
            continue
        distance = s - row["s"]
        alongside = 0.5 * (row["length"] + rows[j]["length"]) + SIDE_GAP_M
        if distance > alongside and distance < LOOK_BACK_M:
            strongest = max(strongest, _behind(row, distance, rows[j]))
    return min(strongest, COURTESY_DECEL + ACCEL_MAX)


@kernel
def _accel_behind(row: np.void, target_speed: float, distance: float, leader: np.void) -> float:
    return idm_free(row["speed"], target_speed, ACCEL_MAX) - _behind(row, distance, leader)


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
        after = _accel_behind(row, desired, ahead, rows[j])
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
            follower_before = _accel_behind(follower, limit, gap + ahead, rows[j])
        follower_after = _accel_behind(follower, limit, gap, row)
        # Who stands or creeps cannot brake for long, whatever the model answers at short distances.
        follower_after = max(follower_after, -follower["speed"] / BRAKE_TIME_S)
    after = max(after, -row["speed"] / BRAKE_TIME_S)
    if after < -MAX_BRAKING_ACCEPTED:
        return False
    return mobil_accepts(accel, after, follower_before, follower_after, 0.0, 0.0, mandatory)


@kernel
def needed_change(roads: RoadArrays, plans: NDArray[np.void], row: np.void) -> int:
    """The side that a vehicle's way needs it to change to by now: 1 left, -1 right, 0 none."""
    step = plans[row["goal"], row["lane"]]
    if step["change"] == 0 or roads.lanes[row["lane"]]["internal"]:
        return 0
    early = (CHANGE_EARLY_M + CHANGE_EARLY_S * row["speed"]) * step["changes"]
    return int(step["change"]) if step["room"] - row["s"] <= early else 0


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
def _choose_lane(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    tick: int,
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
    if row["side_lane"] >= 0 or (tick // 2 + row["id"]) % DECIDE_EVERY_TICKS != 0:
        return 0
    side = 1 if tick % 2 == 0 else -1
    if _may_change(roads, plans, rows, i, side, needed, accel, scratch):
        return side
    return 0


@kernel
def _accel_swinging_out(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    side: int,
    phase: NDArray[np.int32],
    scratch: Scratch,
) -> float:
    """Acceleration of a steered vehicle on its way into a neighbour lane, in m/s².

    It still has to mind its own lane, to the very end, and already the leader in the other one.
    """
    row = rows[i]
    lane = roads.lanes[row["lane"]]
    target = lane["left"] if side > 0 else lane["right"]
    strongest, allowed, _, _ = _road_ahead(roads, plans, rows, i, phase, 0.0, scratch)
    s = row["s"] * roads.lanes[target]["length_m"] / lane["length_m"]
    j, ahead_s = neighbor_ahead(rows, i, target, s, scratch)
    if j >= 0:
        strongest = max(strongest, _behind(row, ahead_s - s, rows[j]))
    return idm_free(row["speed"], allowed, ACCEL_MAX) - strongest


@kernel
def decide(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    num: int,
    driver: int,
    tick: int,
    phase: NDArray[np.int32],
    scratch: Scratch,
) -> None:
    """Decide acceleration and lane change of all vehicles of one kind of driver in one world.

    Args:
        roads: the road arrays.
        plans: PLAN (G, L).
        rows: VEHICLE (C,), the committed state; not written.
        num: rows to decide for, the first of `rows`; all rows stand in the indices.
        driver: DRIVER_* whose rows are decided for.
        tick: of the committed state.
        phase: (num_signals,) PHASE rows that are on.
        scratch: with the lane and link indices of this tick; accel (m/s²), lane_change, blinker,
            hold and link_ahead are written.
    """
    for i in range(num):
        row = rows[i]
        if row["driver"] != driver:
            continue
        strongest, allowed, hold, link_ahead = _road_ahead(
            roads, plans, rows, i, phase, MERGE_ROOM_M, scratch
        )
        side = row["side_lane"]
        if side >= 0:
            s = row["s"] * roads.lanes[side]["length_m"] / roads.lanes[row["lane"]]["length_m"]
            j, ahead_s = neighbor_ahead(rows, i, side, s, scratch)
            if j >= 0:
                strongest = max(strongest, _behind(row, ahead_s - s, rows[j]))
        strongest = max(strongest, _courtesy(roads, rows, i, scratch))
        accel = idm_free(row["speed"], allowed, ACCEL_MAX) - strongest
        needed = needed_change(roads, plans, row)
        change = _choose_lane(roads, plans, rows, i, tick, needed, accel, scratch)
        if change != 0 and driver == DRIVER_AGENT:
            accel = _accel_swinging_out(roads, plans, rows, i, change, phase, scratch)
        scratch.accel[i] = clamp(accel, -ACCEL_LIMIT, ACCEL_LIMIT)
        scratch.lane_change[i] = change
        scratch.blinker[i] = needed
        scratch.hold[i] = hold
        scratch.link_ahead[i] = link_ahead
