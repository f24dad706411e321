"""Where and how fast a waiting departure enters, and whether it can now.

A departure says on which lane of its edge, where on it and how fast it wants to enter, in numbers
or in SUMO's words. It enters only behind a gap that is safe for itself and for its follower.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.rng import STREAM_DEPARTURE, STREAM_PLACE, below, uniform
from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, Travel
from cavmarl.core.records.codes import (
    LANE_BEST,
    LANE_FIRST,
    LANE_GIVEN,
    LANE_RANDOM,
    POS_BASE,
    POS_GIVEN,
    POS_LAST,
    SPEED_AVERAGE,
    SPEED_GIVEN,
    SPEED_LAST,
    SPEED_LIMIT,
    SPEED_MAX,
    SPEED_RANDOM,
)
from cavmarl.core.records.rows import ENTER_REACH_M
from cavmarl.driving.kernels.beside import askew_beside
from cavmarl.driving.kernels.following import LINE_MARGIN_M, accel_behind, speed_behind
from cavmarl.driving.kernels.lane_index import ahead_on, behind_on, comes_over, last_on
from cavmarl.driving.kernels.ways import next_step

ENTER_GAP_M = 1.0  # m between bumpers, the least with which a vehicle enters
ENTER_DECEL = 2.0  # m/s², braking that an entering vehicle may impose, or need at the lane's end
DRAW_LANE = 0  # draws of STREAM_DEPARTURE
DRAW_SPEED = 1


@kernel
def _may_use(travel: Travel, departure: np.void, lane: int) -> bool:
    usable: bool = travel.steps[departure["way"] + lane]["to_go"] < math.inf
    return usable


@kernel
def crowd(scratch: Scratch, lane: int, s: float, view_m: float) -> int:
    """How many vehicles are in view around a place on a lane."""
    found = 0
    for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
        found += abs(scratch.entries[k]["s"] - s) <= view_m
    return found


@kernel
def entry_lane(
    roads: RoadArrays,
    travel: Travel,
    key: np.uint64,
    departure: np.void,
    ranks: NDArray[np.int64],
    taken: NDArray[np.bool_],
) -> int:
    """The LANE where a departure enters in this tick, or -1 if another one tries there.

    Whose lane is chosen by traffic takes the one with the fewest vehicles of those that it may use
    (`best`: from which its way goes on without a lane change, or with the fewest), the right one of
    two.

    `departure`: that enters. `ranks`: how crowded each lane of its edge is; read where traffic
    chooses. `taken`: (L,) lanes on which another one tries in this tick.
    """
    code = departure["lane_code"]
    if code == LANE_GIVEN:
        return -1 if taken[departure["lane"]] else departure["lane"]
    edge = roads.edges[roads.lanes[departure["lane"]]["edge"]]
    first = edge["first_lane"]
    end = first + edge["num_lanes"]
    usable = 0
    fewest = 1 << 20  # lane changes on its way
    for lane in range(first, end):
        if _may_use(travel, departure, lane):
            usable += 1
            fewest = min(fewest, int(travel.steps[departure["way"] + lane]["changes"]))
    pick = -1
    if code == LANE_RANDOM and usable > 0:
        pick = below(key, departure["id"], 0, STREAM_DEPARTURE + DRAW_LANE, usable)
    best = -1
    best_rank = 1 << 40
    for lane in range(first, end):
        if not _may_use(travel, departure, lane):
            continue
        if code == LANE_RANDOM:
            if pick == 0:
                return -1 if taken[lane] else lane
            pick -= 1
            continue
        if code == LANE_FIRST:
            return -1 if taken[lane] else lane
        changes = int(travel.steps[departure["way"] + lane]["changes"])
        if taken[lane] or (code == LANE_BEST and changes > fewest):
            continue  # where another one tries on the best, it waits
        rank = ranks[lane - first]
        if rank < best_rank:
            best = lane
            best_rank = rank
    return best


@kernel
def entry_place(
    roads: RoadArrays,
    key: np.uint64,
    departure: np.void,
    kind: np.void,
    lane: int,
    tick: int,
    scratch: Scratch,
    view_m: float,
) -> float:
    """Where on its lane the centre of a departure enters, in m.

    Its whole body is on the lane, its front before the line; on one that is too short for both, its
    rear is behind the start.
    """
    length = roads.lanes[lane]["length_m"]
    half = 0.5 * kind["length"]
    most = max(length - half, half)
    code = departure["pos_code"]
    if code == POS_GIVEN:
        front = departure["pos"]
        s = front - half if front >= 0.0 else length + front - half
    elif code == POS_BASE:
        s = half
    elif code == POS_LAST:
        k = last_on(scratch, lane, departure["id"], 0.0, view_m)
        s = most
        if k >= 0:
            last = scratch.entries[k]
            s = last["s"] - last["half"] - kind["min_gap"] - half
    else:
        s = half + (most - half) * uniform(key, departure["id"], tick, STREAM_PLACE)
    return float(min(max(s, half), max(length - half - LINE_MARGIN_M, 0.0)))


@kernel
def speed_at(roads: RoadArrays, kind: np.void, lane: int, s: float, wanted: float) -> float:
    """At most `wanted`, at most the machine's, and slow before the end of the lane."""
    rest = max(roads.lanes[lane]["length_m"] - s - 0.5 * kind["length"] - 2.0, 0.0)
    return float(min(wanted, kind["max_speed"], math.sqrt(2.0 * ENTER_DECEL * rest)))


@kernel
def entry_speed(
    roads: RoadArrays,
    travel: Travel,
    rows: NDArray[np.void],
    key: np.uint64,
    departure: np.void,
    kind: np.void,
    lane: int,
    s: float,
    scratch: Scratch,
) -> float:
    """The speed in m/s with which a departure enters somewhere, -1 if a leader is too near.

    A steered vehicle that sticks out into its lane as it changes to the next one is a leader, too.
    """
    here = roads.lanes[lane]
    code = departure["speed_code"]
    wanted = here["speed_mps"] * departure["speed_factor"]
    half = 0.5 * kind["length"]
    j = ahead_on(scratch, lane, s, departure["id"], travel.view_m)
    distance = -s
    if j < 0:
        beyond, _, _ = next_step(roads, travel, lane, departure["way"])
        if beyond >= 0:
            distance += here["length_m"]
            j = last_on(scratch, beyond, departure["id"], distance, travel.view_m)
    if code == SPEED_GIVEN:
        wanted = min(departure["speed"], wanted)
    elif code == SPEED_RANDOM:
        wanted *= uniform(key, departure["id"], 0, STREAM_DEPARTURE + DRAW_SPEED)
    elif code == SPEED_LIMIT:
        wanted = min(wanted, here["speed_mps"])
    elif code == SPEED_AVERAGE:
        wanted = min(wanted, _mean_speed(here["speed_mps"], lane, s, travel.view_m, scratch))
    elif code == SPEED_LAST and j >= 0:
        wanted = min(wanted, scratch.entries[j]["speed"])
    wanted = speed_at(roads, kind, lane, s, wanted)
    safe = math.inf
    if j >= 0:
        safe = _safe_behind(kind, scratch.entries[j], distance + scratch.entries[j]["s"] - half)
    for to_left in (True, False):
        k, apart = askew_beside(roads, travel, rows, lane, s, departure["id"], to_left, scratch)
        if k >= 0:
            safe = min(safe, _safe_behind(kind, scratch.entries[k], apart - half))
    slows = code == SPEED_MAX or code == SPEED_RANDOM  # the others wait until theirs is safe
    if safe < 0.0 or (safe < wanted and not slows):
        return -1.0
    return min(wanted, safe)


@kernel
def _mean_speed(limit_mps: float, lane: int, s: float, view_m: float, scratch: Scratch) -> float:
    """Mean speed in m/s of those on a lane, in view of place `s`; none: the limit."""
    total, number = 0.0, 0
    for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
        other = scratch.entries[k]
        if not other["side"] and abs(other["s"] - s) <= view_m:
            total += other["speed"]
            number += 1
    return total / number if number > 0 else limit_mps


@kernel
def _safe_behind(kind: np.void, leader: np.void, to_centre: float) -> float:
    """The speed in m/s that is safe behind an entry whose centre is so far ahead; -1: too near."""
    gap = to_centre - leader["half"]
    if gap < ENTER_GAP_M:
        return -1.0
    return speed_behind(kind, gap, leader["speed"], leader["decel"])


@kernel
def follower_brakes(
    roads: RoadArrays,
    travel: Travel,
    rows: NDArray[np.void],
    departure: np.void,
    kind: np.void,
    lane: int,
    s: float,
    speed: float,
    scratch: Scratch,
) -> bool:
    """Whether a follower, by whichever lane it comes, would have to brake hard for an entrant."""
    own_id = departure["id"]
    half = 0.5 * kind["length"]
    k = behind_on(scratch, lane, s, own_id)
    if k >= 0:
        apart = s - scratch.entries[k]["s"]
        seen = apart <= travel.view_m
        return seen and _brakes(roads, travel, rows, kind, lane, k, apart - half, speed, scratch)
    row = roads.lanes[lane]
    for n in range(row["first_into"], row["first_into"] + row["num_into"]):
        k, apart = comes_over(
            roads, scratch, roads.into[n], s, own_id, ENTER_REACH_M, travel.view_m
        )
        if k >= 0 and _brakes(roads, travel, rows, kind, lane, k, apart - half, speed, scratch):
            return True
    return False


@kernel
def _brakes(
    roads: RoadArrays,
    travel: Travel,
    rows: NDArray[np.void],
    kind: np.void,
    lane: int,
    k: int,
    apart: float,
    speed: float,
    scratch: Scratch,
) -> bool:
    """Whether entry k, whose centre is `apart` m behind the rear of an entrant, brakes hard."""
    follower = scratch.entries[k]
    gap = apart - follower["half"]
    if gap < ENTER_GAP_M:
        return True
    other = rows[follower["row"]]
    theirs = travel.types[other["vtype"]]
    desired = roads.lanes[lane]["speed_mps"] * other["speed_factor"]
    pace = follower["speed"]
    hard: bool = accel_behind(theirs, pace, desired, gap, speed, kind["decel"]) < -ENTER_DECEL
    return hard
