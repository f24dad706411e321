"""Drivers: the acceleration and the lane change of each vehicle, from the state before the tick.

Accelerations follow the car-following model of the vehicle's type, lane changes follow MOBIL. This
file finds the inputs of these models:

- the leader, also on the next lanes and after a junction;
- the next lower speed limit, and the end of the lane;
- the line at which the vehicle must stop, for a signal or for vehicles with the right of way;
- a vehicle that wants to merge;
- the lane that the route needs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.compiled.prefetch import SOON, prefetch
from cavmarl.core.math.geometry import wrap_angle
from cavmarl.core.math.rng import STREAM_DRIVER, quick_uniform
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
)
from cavmarl.core.records.rows import is_lost, is_steered
from cavmarl.driving.kernels.junctions.deadlocks import resolves_deadlocks
from cavmarl.driving.kernels.junctions.gaps import is_minor
from cavmarl.driving.kernels.junctions.junctions import (
    SEE_FOES_M,
    STOP_LINE_M,
    before_waiting,
    behind_merging,
    constraint_inside,
    has_crept_over_red,
    hold_at_line,
    hold_inside,
)
from cavmarl.driving.kernels.junctions.swept_areas import (
    before_foe_sweep,
    before_foe_sweep_beyond_junction,
    before_line_gently,
    behind_fork,
    room_m,
    stop_before_foe_sweep,
)
from cavmarl.driving.kernels.junctions.zippers import behind_in_zipper, is_zipper
from cavmarl.driving.kernels.lanes.adjacent_leaders import (
    behind_adjacent_leader,
    behind_askew,
    behind_entry,
    rear_swing_m,
)
from cavmarl.driving.kernels.lanes.cooperative_braking import COOPERATIVE_DECEL, brake_for_merging
from cavmarl.driving.kernels.lanes.lane_choice import (
    CREEP_MPS,
    MERGE_ROOM_M,
    SIDEWAYS_S,
    choose_lane,
    considers_lane_change,
    needed_change,
    room_for_further_changes,
    wish_on_lane,
)
from cavmarl.driving.kernels.lanes.lane_ends import (
    behind_over_line,
    constraint_of_side_lane,
    constraint_over_lane_end,
    lane_end,
    misses_last_change,
)
from cavmarl.driving.kernels.lanes.lane_index import VIEW_M, last_on
from cavmarl.driving.kernels.lanes.route_following import free_speed, next_step, next_step_from
from cavmarl.driving.kernels.lanes.side_clearance import STAYS_ASIDE, has_to_stay_aside
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M
from cavmarl.driving.kernels.models.following import before_line, no_constraint, response, wish
from cavmarl.driving.kernels.motion.ordered_stops import distance_to_stop
from cavmarl.driving.kernels.motion.speed_limits_ahead import bend_speed, speed_before_limit

SEE_LINE_M = 12.0  # at rest, a driver sees lines up to here; areas are swept up to 10.5 m before
CLOSER_M = 0.9  # a driver that resolves deadlocks stops this much closer than `LINE_MARGIN_M`
# Around a corner, if the gap to the leader is below `NEAR_M` and the headings differ by more than
# `ASKEW_RAD`, half the leader's width is subtracted from the gap.
NEAR_M = 8.0
ASKEW_RAD = 0.7
NEXT_LINE_M = 5.0  # a vehicle with a leader looks for a line this far beyond its braking distance
# At this distance before the place where a lane change must be made, a driver adapts to the leader
# on the other lane.
FALL_IN_M = 100.0
# `MERGE_ROOM_M` of a steered vehicle during a lane change: the front stops 0.2 m before the end of
# the lane, closer than before a line.
CHANGING_ROOM_M = -0.8
MISSED_ROOM_M = 1.5  # additional room if the lane leads to a turn that the vehicle cannot take
ACROSS_SHARE = 0.25  # lateral offset in lane widths from which the front covers the other lane
CREEPS_MPS = 0.8 * CREEP_MPS  # speed of a lane change near the end of the lane
KEPT_MPS = 0.1  # a leader that allows only a lower speed blocks the vehicle
ROW_LINES = 3  # cache lines of a VEHICLE row that drivers read
FAST_MPS = 5.0  # below this speed, a background driver ignores vehicles that merge ahead of it
RETURN_MPS = 5.0  # speed of a lost vehicle that searches for its lane


@inlined_kernel
def look_ahead_m(kind: np.void, speed: float) -> float:
    """Return how far ahead of its centre a driver looks, in m."""
    if kind["as_sumo"]:
        way = 45.0 + speed * (1.0 + kind["tau"]) + 0.5 * speed * speed / kind["decel"]
    else:
        way = 30.0 + 2.0 * speed + 0.2 * speed * speed
    return float(min(way, VIEW_M))


@inlined_kernel
def see_line_m(kind: np.void, speed: float) -> float:
    """Return the distance in m, from the front, at which a driver reacts to a line.

    Drivers with a model of SUMO react when they may soon have to brake. Other drivers react as soon
    as they see the line.
    """
    if kind["as_sumo"]:
        braking = 0.6 * speed * speed / kind["decel"]
        return float(SEE_LINE_M + speed * (1.0 + kind["tau"]) + braking)
    return VIEW_M


@kernel
def _is_askew(row: np.void, leader: np.void) -> bool:
    """Return whether the side of a leader around a corner is nearer than its rear."""
    askew: bool = abs(wrap_angle(leader["heading"] - row["heading"])) > ASKEW_RAD
    return askew


@kernel
def decide_at_line(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    kind: np.void,
    link: int,
    distance: float,
    way: int,
    phase: NDArray[np.int32],
    dt: float,
    scratch: Scratch,
) -> tuple[float, int, float]:
    """Evaluate the stop line of `link` for row i; the end of the lane is `distance` m ahead.

    Returns:
        The constraint; the reason to stop (HOLD_*); the distance in m at which the vehicle stops,
        infinite if it does not stop.
    """
    row = rows[i]
    speed = row["speed"]
    front = distance - 0.5 * row["length"]
    to_line = front - roads.lanes[roads.links[link]["from_lane"]]["stop_back_m"]
    if to_line <= 0.0 and has_crept_over_red(roads, row, link, -to_line, phase):
        return before_line(kind, speed, 0.0, dt), HOLD_SIGNAL, 0.0
    if to_line <= 0.0:
        # The front has passed the line, so the vehicle does not wait there.
        constraint, hold, waits = constraint_inside(
            roads, travel, rows, i, link, -distance, way, phase, dt, scratch
        )
        swept = before_foe_sweep(roads, rows, i, kind, link, front, waits, dt, scratch)
        return max(constraint, swept), hold, math.inf
    merging = no_constraint(kind)
    if is_steered(row) or speed > FAST_MPS:
        merging = behind_merging(roads, kind, row, link, distance, scratch)
    if is_zipper(roads, link):
        zipper = behind_in_zipper(roads, travel, rows, i, kind, link, distance, scratch)
        merging = max(merging, zipper)
    hold = hold_at_line(roads, travel, rows, i, link, distance, way, phase, scratch)
    waits = HOLD_NONE
    if hold == HOLD_NONE:
        waits = hold_inside(roads, travel, rows, i, link, distance, way, phase, scratch)
    stop = math.inf
    if roads.links[link]["num_sweeps"] > 0:
        room = room_m(hold, waits)
        stop = front + stop_before_foe_sweep(roads, rows, i, link, -front, room, scratch)
    if hold != HOLD_NONE:
        to_line = min(to_line, max(stop, 0.0))
        closer = CLOSER_M if resolves_deadlocks(roads, travel, row, link) else 0.0
        return before_line(kind, speed, min(to_line + closer, stop), dt), hold, to_line
    constraint = merging
    minor = kind["as_sumo"] and is_minor(roads, link, phase)
    if roads.links[link]["wait_m"] < math.inf:
        inside = before_waiting(roads, kind, row, link, -front, waits, minor, dt)
        constraint = max(constraint, inside)
    elif minor and front > SEE_FOES_M:
        constraint = max(constraint, before_line(kind, speed, front + LINE_MARGIN_M, dt))
    if stop < math.inf:
        constraint = max(constraint, before_line_gently(kind, row, stop, dt))
    return constraint, HOLD_NONE, stop if stop <= front else math.inf


@inlined_kernel
def _road_ahead(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    k: int,
    step: np.void,
    phase: NDArray[np.int32],
    merge_room_m: float,
    dt: float,
    scratch: Scratch,
) -> tuple[float, float, int, int]:
    """Follow the route of the vehicle of entry k and collect its constraints.

    `step` is the PLAN of the vehicle's lane. A vehicle stopped close behind its leader does not
    look further ahead if the stop line is far: no other constraint could be stronger. Before the
    end of a lane that the route does not follow, the vehicle stops `merge_room_m` m early.

    Returns:
        The binding constraint; the allowed speed in m/s; the reason to stop (HOLD_*); the LINK with
        a near stop line, or -1.
    """
    own = scratch.entries[k]
    i = own["row"]
    row = rows[i]
    kind = travel.types[row["vtype"]]
    speed = row["speed"]
    half = own["half"]
    steered = is_steered(row)
    lane = row["lane"]
    here = roads.lanes[lane]
    distance = here["length_m"] - row["s"]
    queues = speed == 0.0 and kind["as_sumo"] and not here["internal"]
    if queues and k + 1 < scratch.lane_end[lane] and distance >= half + NEXT_LINE_M:
        leader = scratch.entries[k + 1]
        gap = leader["s"] - row["s"] - half - leader["half"]
        constraint = behind_entry(kind, speed, gap, leader)
        if constraint == 0.0:
            return constraint, 0.0, HOLD_NONE, -1
    allowed = free_speed(here, kind, row["speed_factor"])
    if steered:
        allowed = min(allowed, bend_speed(roads, lane, lane, -row["s"]))
    constraint = no_constraint(kind)
    hold = HOLD_NONE
    kept = no_constraint(kind)  # the constraint of the leader; set below
    link_ahead = -1
    if here["internal"]:
        place = here["link_offset_m"] + row["s"]
        before = roads.links[here["link"]]["from_lane"]
        fork = behind_fork(roads, kind, row, before, here["link"], -place, dt, scratch)
        constraint, hold, waits = constraint_inside(
            roads, travel, rows, i, here["link"], place, row["way"], phase, dt, scratch
        )
        swept = before_foe_sweep(
            roads, rows, i, kind, here["link"], -place - half, waits, dt, scratch
        )
        constraint = max(constraint, fork, swept)
    else:
        constraint = before_foe_sweep_beyond_junction(roads, rows, i, kind, dt, scratch)
    look = min(look_ahead_m(kind, speed), travel.view_m)
    see = min(see_line_m(kind, speed) + half, travel.see_m)
    # A driver with a leader on the same lane may ignore the next line as long as it could still
    # stop there after the leader has passed the line.
    if k + 1 < scratch.lane_end[lane] and (scratch.entries[k + 1]["s"] - row["s"] <= travel.view_m):
        leader = scratch.entries[k + 1]
        gap = leader["s"] - row["s"] - half - leader["half"]
        gap -= rear_swing_m(roads, travel, rows, leader)
        kept = behind_entry(kind, speed, gap, leader)
        constraint = max(constraint, kept)
        look = min(look, half + NEXT_LINE_M + speed + 0.5 * speed * speed / kind["decel"])
    way = row["way"]
    while distance < look:
        before = lane
        before_way = way
        if before == row["lane"] and before_way == row["way"]:
            lane, way, link = next_step_from(roads, step, before, way)
        else:
            lane, way, link = next_step(roads, travel, before, way)
        if lane < 0 or (steered and misses_last_change(roads, travel, before, before_way)):
            end = lane_end(roads, travel, row, kind, before, before_way, distance, merge_room_m, dt)
            over = constraint_over_lane_end(
                roads, rows, i, kind, before, distance, distance < see, dt, scratch
            )
            constraint = max(constraint, end, over)
            break
        stops = False
        if link >= 0 and distance < see:
            fork = behind_fork(roads, kind, row, before, link, distance, dt, scratch)
            at_line, found, to_stop = decide_at_line(
                roads, travel, rows, i, kind, link, distance, way, phase, dt, scratch
            )
            stops = to_stop < math.inf
            to_line = distance - half - roads.lanes[before]["stop_back_m"]
            if min(to_line, to_stop) < STOP_LINE_M:
                link_ahead = link if link_ahead < 0 else link_ahead
            kept = max(kept, fork)
            constraint = max(constraint, fork, at_line)
            hold = found if found != HOLD_NONE else hold
        ahead = roads.lanes[lane]
        limit = ahead["speed_mps"] * row["speed_factor"]
        if steered:
            allowed = min(allowed, bend_speed(roads, before, lane, distance))
        if limit < allowed:
            allowed = min(allowed, speed_before_limit(kind, limit, distance, speed, dt))
        j = last_on(scratch, lane, row["id"], distance, travel.view_m)
        if j >= 0:
            leader = scratch.entries[j]
            gap = distance + leader["s"] - half - leader["half"]
            if gap < NEAR_M and _is_askew(row, rows[leader["row"]]):
                gap -= 0.5 * rows[leader["row"]]["width"]
            gap -= rear_swing_m(roads, travel, rows, leader)
            kept = max(kept, behind_entry(kind, speed, gap, leader))
            constraint = max(constraint, kept)
        elif stops:
            over = behind_over_line(roads, travel, row, kind, lane, way, distance, scratch)
            constraint = max(constraint, over)
        if steered:
            aside = behind_askew(roads, travel, rows, kind, row, lane, -distance, scratch)
            constraint = max(constraint, aside)
        if j >= 0 or stops:
            break
        distance += ahead["length_m"]
    if hold == HOLD_YIELD and speed < KEPT_MPS and -kept < KEPT_MPS:
        if kind["as_sumo"] and not here["internal"]:
            hold = HOLD_EXIT_BLOCKED  # the leader blocks row i, so others need not yield to it
    return constraint, allowed, hold, link_ahead


@inlined_kernel
def _prefetch_first(
    roads: RoadArrays, rows: NDArray[np.void], i: int, step: NDArray[np.void], scratch: Scratch
) -> None:
    """Prefetch the data that the decision of row i reads first: its row, next link and lane."""
    for line in range(ROW_LINES):
        prefetch(rows, i, line)
    link, ahead = step[i]["link"], step[i]["next"]
    prefetch(roads.links, link, 0)
    prefetch(roads.links, link, 1)
    prefetch(scratch.link_start, link, 0)
    prefetch(roads.lanes, ahead, 0)
    prefetch(scratch.lane_start, ahead, 0)


@inlined_kernel
def _prefetch_further(roads: RoadArrays, step: np.void, scratch: Scratch) -> None:
    """Prefetch the data that the decision reads next: foes on the junction, and the next lane."""
    link = step["link"]
    if link < 0 or link >= roads.links.shape[0]:  # a scripted vehicle has no step
        return
    first = roads.links[link]["first_conflict"]
    prefetch(roads.conflicts, first, 0)
    prefetch(roads.conflicts, first, 1)
    ahead = roads.lanes[roads.links[link]["next_lane"]]["successor"]
    prefetch(roads.lanes, ahead, 0)
    prefetch(scratch.lane_start, ahead, 0)


@kernel
def decide(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,), the state before the tick; read-only
    num: int,  # decide for the first `num` rows; the lane and link indices contain all rows
    driver: int,  # only for rows with this DRIVER_*
    tick: int,  # tick of this state
    dt: float,  # s for which a decision is valid: a tick, or an agent's step
    phase: NDArray[np.int32],  # (num_signals,) active PHASE rows
    step: NDArray[np.void],  # (C,) the PLAN of each row's lane
    # with the lane and link indices of this tick; accel (m/s²), lane_change, blinker, hold and
    # link_ahead are written
    scratch: Scratch,
) -> None:
    """Decide acceleration and lane change of all vehicles of one world with one kind of driver."""
    total = scratch.lane_start[roads.lanes.shape[0]]
    for k in range(total):
        if k + SOON < total:
            first, further = scratch.entries[k + SOON]["row"], scratch.entries[k + SOON // 2]["row"]
            if first < num:
                _prefetch_first(roads, rows, first, step, scratch)
            if further < num:
                _prefetch_further(roads, step[further], scratch)
        i = scratch.entries[k]["row"]
        if scratch.entries[k]["side"] or i >= num or rows[i]["driver"] != driver:
            continue
        row = rows[i]
        kind = travel.types[row["vtype"]]
        speed = row["speed"]
        further_m = 0.0
        if driver == DRIVER_AGENT and step[i]["changes"] > 1:
            further_m = room_for_further_changes(roads.lanes[row["lane"]], row, step[i])
        room_m = MERGE_ROOM_M + further_m
        if driver == DRIVER_AGENT and misses_last_change(roads, travel, row["lane"], row["way"]):
            room_m += MISSED_ROOM_M
        constraint, allowed, hold, link_ahead = _road_ahead(
            roads, travel, rows, k, step[i], phase, room_m, dt, scratch
        )
        to_stop = distance_to_stop(roads, travel, row)
        if to_stop < math.inf:
            constraint = max(constraint, before_line(kind, speed, to_stop + LINE_MARGIN_M, dt))
        askew = no_constraint(kind)
        if driver == DRIVER_AGENT:
            askew = behind_askew(roads, travel, rows, kind, row, row["lane"], row["s"], scratch)
            constraint = max(constraint, askew)
        if row["side_lane"] >= 0:
            see = min(see_line_m(kind, speed), travel.see_m)
            aside = constraint_of_side_lane(roads, travel, rows, i, kind, see, dt, scratch)
            constraint = max(constraint, aside)
        needed = needed_change(roads, travel, row, step[i])
        change = 0
        if considers_lane_change(row, needed, tick, dt):
            own_wish = wish(kind, speed, allowed, constraint)
            if driver == DRIVER_AGENT:
                own_wish = wish_on_lane(roads, travel, row, k, scratch)
            change = choose_lane(roads, travel, rows, i, tick, needed, own_wish, scratch)
        if change != 0 and driver == DRIVER_AGENT:
            # During a lane change, a steered vehicle reacts to the leaders on both lanes. It may
            # drive to the very end of its own lane, because a stopped vehicle cannot steer.
            lane = roads.lanes[row["lane"]]
            room_m = CHANGING_ROOM_M + further_m
            if change * row["d"] > ACROSS_SHARE * lane["width_m"]:
                room_m -= 0.5 * row["length"]
            constraint, allowed, _, _ = _road_ahead(
                roads, travel, rows, k, step[i], phase, room_m, dt, scratch
            )
            target = lane["left"] if change > 0 else lane["right"]
            aside = behind_adjacent_leader(roads, travel, kind, row, target, scratch)
            constraint = max(constraint, askew, aside)
            if lane["length_m"] - row["s"] < 0.5 * row["length"] + SIDEWAYS_S * CREEP_MPS:
                # At a higher speed, the vehicle would reach the end of the lane before it has
                # changed.
                allowed = min(allowed, CREEPS_MPS)
        share = 0.0
        if kind["sigma"] > 0.0:
            share = quick_uniform(row["rng_key"], row["id"], tick, STREAM_DRIVER)
        accel = response(kind, speed, allowed, constraint, share, dt)
        if needed != 0 and change == 0 and driver == DRIVER_BACKGROUND:
            lane = roads.lanes[row["lane"]]
            target = lane["left"] if needed > 0 else lane["right"]
            room = step[i]["room"] - row["s"]
            if target >= 0 and room < FALL_IN_M:
                # Adapt to the future leader on the other lane.
                fall_in = wish(
                    kind,
                    speed,
                    allowed,
                    behind_adjacent_leader(roads, travel, kind, row, target, scratch),
                )
                accel = min(accel, max(fall_in, -COOPERATIVE_DECEL))
        if driver == DRIVER_BACKGROUND and has_to_stay_aside(roads, rows, row, scratch):
            change = STAYS_ASIDE
        scratch.accel[i] = accel
        scratch.lane_change[i] = change
        scratch.blinker[i] = needed
        scratch.hold[i] = hold
        scratch.link_ahead[i] = link_ahead
    if driver == DRIVER_AGENT:
        for i in range(num):
            if is_lost(rows[i]):
                kind = travel.types[rows[i]["vtype"]]
                speed = rows[i]["speed"]
                scratch.accel[i] = response(kind, speed, RETURN_MPS, no_constraint(kind), 0.0, dt)
                scratch.lane_change[i] = 0
    for k in range(total):
        entry = scratch.entries[k]
        if entry["blinker"] != 0 and not entry["side"]:
            brake_for_merging(roads, travel, rows, rows[entry["row"]], scratch)
