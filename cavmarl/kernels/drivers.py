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
from cavmarl.kernels.car_following import ACCEL_LIMIT, ACCEL_MAX, idm_free
from cavmarl.kernels.codes import DRIVER_AGENT, HOLD_NONE
from cavmarl.kernels.following import LINE_MARGIN_M, before_line, behind
from cavmarl.kernels.junctions import conflict_inside, may_enter
from cavmarl.kernels.lane_choice import LOOK_BACK_M, SIDE_GAP_M, choose_lane, needed_change
from cavmarl.kernels.lanes import last_on_lane, neighbor_ahead
from cavmarl.kernels.scalars import clamp

__all__ = ["LOOK_AHEAD_M", "decide"]

LOOK_AHEAD_M = 250.0  # no driver looks further
STOP_LINE_M = 5.0  # standing with the front nearer than this counts as standing at the line
LIMIT_DECEL = 2.0  # m/s², how a driver slows for a lower limit ahead,
LIMIT_LEAD_S = 1.0  # to be down this time before it, as the model lags behind what is allowed
SHARED_START_M = 7.0  # two links from one lane share about this much of their way
COURTESY_DECEL = 2.0  # m/s², the hardest braking to let somebody merge
# A driver that has to leave a lane waits this far before its end to change right, twice as far to
# change left: two that want to swap lanes do not stand side by side for ever.
MERGE_ROOM_M = 10.0
MERGE_ROOM_SHARE = 0.25  # at most this share of the lane's length
LATERAL_ACCEL = 2.5  # m/s², with which a steered car takes a bend: where a lane turns
MIN_BEND_RAD = 0.2  # by more than this
BEND_M = 6.0  # within this length


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
                strongest = max(strongest, behind(row, distance + place, other))
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
            strongest = before_line(row, to_foe)
    while True:
        if j >= 0:
            strongest = max(strongest, behind(row, distance + s, rows[j]))
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
                strongest = max(strongest, before_line(row, distance - length + place))
            break
        if step["link"] >= 0:
            if distance - half < STOP_LINE_M and link_ahead < 0:
                link_ahead = step["link"]
            hold = may_enter(roads, rows, i, step["link"], distance, phase, scratch)
            if hold != HOLD_NONE:
                strongest = max(strongest, before_line(row, distance - half))
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
            strongest = max(strongest, behind(row, distance, rows[j]))
    return min(strongest, COURTESY_DECEL + ACCEL_MAX)


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
        strongest = max(strongest, behind(row, ahead_s - s, rows[j]))
    return idm_free(row["speed"], allowed, ACCEL_MAX) - strongest


@kernel
def decide(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    num: int,
    driver: int,
    tick: int,
    dt: float,
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
        dt: seconds of a tick.
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
                strongest = max(strongest, behind(row, ahead_s - s, rows[j]))
        strongest = max(strongest, _courtesy(roads, rows, i, scratch))
        accel = idm_free(row["speed"], allowed, ACCEL_MAX) - strongest
        needed = needed_change(roads, plans, row)
        change = choose_lane(roads, plans, rows, i, tick, dt, needed, accel, scratch)
        if change != 0 and driver == DRIVER_AGENT:
            accel = _accel_swinging_out(roads, plans, rows, i, change, phase, scratch)
        scratch.accel[i] = clamp(accel, -ACCEL_LIMIT, ACCEL_LIMIT)
        scratch.lane_change[i] = change
        scratch.blinker[i] = needed
        scratch.hold[i] = hold
        scratch.link_ahead[i] = link_ahead
