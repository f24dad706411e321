"""Lane choice: the lane that a driver wants, for its route or for speed, and whether it may change.

MOBIL decides (`lane_change`). This file finds the vehicles that count and the lane changes that the
route needs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.rows import is_steered
from cavmarl.driving.kernels.lanes.lane_change import (
    LANE_CHANGE_DELAY_S,
    MAX_BRAKING_IMPOSED,
    MIN_ACCEL_GAIN,
    mobil_accepts,
)
from cavmarl.driving.kernels.lanes.lane_index import (
    ahead_on,
    behind_by,
    beside_s,
    last_on,
    num_ahead,
)
from cavmarl.driving.kernels.lanes.route_following import free_speed, next_step
from cavmarl.driving.kernels.lanes.side_clearance import has_side_clearance
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M
from cavmarl.driving.kernels.models.following import accel_behind, no_constraint, wish
from cavmarl.driving.kernels.motion.ordered_stops import STAY, change_for_stop
from cavmarl.roads.kernels.lanes_now import is_closed
from cavmarl.roads.kernels.plans import is_barred

LOOK_BACK_M = 60.0  # distance within which followers count for a lane change
# Drivers start to look for a gap before a mandatory change at this distance plus this travel time.
CHANGE_EARLY_M = 80.0
CHANGE_EARLY_S = 12.0
MAX_BRAKING_ACCEPTED = 4.0  # m/s², largest deceleration that a driver accepts behind a new leader
MAX_BRAKING_NEEDED = 4.0  # m/s², largest deceleration that a mandatory change imposes
QUEUED_M = 7.5  # length of lane per vehicle in a queue
TURN_IN_M = 5.0  # up to this far behind a junction, turning long vehicles cover adjacent lanes
SPARE_M = 2.0  # on a short lane, `TURN_IN_M` is reduced so that this much room is left
SLOW_MPS = 2.0  # below this speed, a lane change needs side clearance to stopped vehicles
MIN_SPEED_MPS = 1.0  # slower cars change lanes only if their route needs it
CREEP_MPS = 1.0  # up to this speed, a mandatory change is possible up to the lane's very end
SIDEWAYS_S = 2.5  # duration of a lane change, which has to end before the lane does
BRAKE_TIME_S = 0.5  # braking that ends within this time does not count
SIDE_GAP_M = 1.0  # smallest gap between bumpers with which a lane change starts
# To change to the right, a driver waits this far before the end of its lane; to change to the left,
# it waits its length and `SWAP_ROOM_M` earlier. So two vehicles that swap lanes do not block each
# other.
MERGE_ROOM_M = 2.0
SWAP_ROOM_M = 3.0
# Smallest `SWAP_ROOM_M` of a background vehicle, if its rear would otherwise be in the junction.
LEAST_SWAP_M = SIDE_GAP_M + 0.2
LINE_SLACK_M = 0.3  # a vehicle may stop this far before the place where it should wait
MERGE_ROOM_SHARE = 0.25  # largest room for a change to the right, as a share of the lane's length


@inlined_kernel
def needed_change(roads: RoadArrays, travel: TripTables, row: np.void, step: np.void) -> int:
    """Return the side of the lane change that the route needs now: 1 left, -1 right, 0 none.

    `step` is the PLAN of the vehicle's lane.
    """
    lane = row["lane"]
    if roads.lanes[lane]["internal"]:
        return 0
    to_stop = change_for_stop(roads, travel, row)
    if to_stop != 0:
        return to_stop if to_stop != STAY else 0
    if step["change"] == 0:
        return 0
    early = (CHANGE_EARLY_M + CHANGE_EARLY_S * row["speed"]) * step["changes"]
    return int(step["change"]) if step["room"] - row["s"] <= early else 0


@inlined_kernel
def room_for_further_changes(lane: np.void, row: np.void, step: np.void) -> float:
    """Return the room in m for all lane changes of a steered vehicle except the first."""
    further = (step["changes"] - 1) * (row["length"] + SWAP_ROOM_M)
    return float(min(further, max(MERGE_ROOM_SHARE * lane["length_m"] - MERGE_ROOM_M, 0.0)))


@kernel
def wish_on_lane(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    k: int,  # the vehicle's entry
    scratch: Scratch,
) -> float:
    """Return the desired acceleration in m/s² of a steered vehicle on its lane.

    Only the leader counts: bends, lines and limits ahead affect both lanes and are not a reason to
    change lanes.
    """
    lane = row["lane"]
    kind = travel.types[row["vtype"]]
    desired = free_speed(roads.lanes[lane], kind, row["speed_factor"])
    # Leaders beyond the view may belong to another zone and may be unknown here.
    follows = (
        k + 1 < scratch.lane_end[lane] and scratch.entries[k + 1]["s"] - row["s"] <= travel.view_m
    )
    if not follows:
        return wish(kind, row["speed"], desired, no_constraint(kind))
    leader = scratch.entries[k + 1]
    gap = leader["s"] - row["s"] - 0.5 * row["length"] - leader["half"]
    return accel_behind(kind, row["speed"], desired, gap, leader["speed"], leader["decel"])


@inlined_kernel
def _has_rear_close_beyond(scratch: Scratch, lane: np.void, front: float, gap_m: float) -> bool:
    """Return whether the rear of a vehicle that is leaving a lane is less than `gap_m` m ahead.

    `front` is the distance in m from the ego front to the end of the lane.
    """
    for link in range(lane["first_link"], lane["first_link"] + lane["num_links"]):
        for k in range(scratch.link_start[link], scratch.link_end[link]):
            leaves = scratch.approach[k]
            rear = -leaves["dist"] - leaves["half"]
            if leaves["dist"] <= 0.0 and rear < 0.0 and front + rear < gap_m:
                return True
    return False


@inlined_kernel
def _next_beyond(
    roads: RoadArrays, travel: TripTables, row: np.void, lane: int, far: float, scratch: Scratch
) -> tuple[int, float]:
    """Find the next vehicle behind the end of a lane, which is `far` m ahead.

    The search ends with the first lane behind the next junction.

    Returns:
        The vehicle's entry and the distance of its centre in m; or -1 and the searched distance.
    """
    j = -1
    beyond, way, _ = next_step(roads, travel, lane, row["way"])
    while beyond >= 0:
        j = last_on(scratch, beyond, row["id"], far, travel.view_m)
        if j >= 0:
            far += scratch.entries[j]["s"]
        if j >= 0 or not roads.lanes[beyond]["internal"]:
            break
        far += roads.lanes[beyond]["length_m"]
        beyond, way, _ = next_step(roads, travel, beyond, way)
    return j, far


@kernel
def imposed_on_followers(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    row: np.void,
    target: int,
    s: float,
    scratch: Scratch,
) -> float:
    """Return the lowest acceleration in m/s² that a change to `s` on `target` imposes on others.

    The result is -inf if a vehicle is beside that place. A fast follower far behind may have to
    brake harder than a stopped follower nearby, so every lane that leads to `target` is searched.
    """
    kind = travel.types[row["vtype"]]
    half = 0.5 * row["length"]
    least = 0.0
    for n in range(max(1, roads.lanes[target]["num_into"])):
        k, gap = behind_by(roads, scratch, target, s, row["id"], n, LOOK_BACK_M, travel.view_m)
        if k < 0:
            continue
        follower = scratch.entries[k]
        if gap < half + follower["half"] + SIDE_GAP_M:
            return -math.inf
        other = rows[follower["row"]]
        theirs = travel.types[other["vtype"]]
        pace = follower["speed"]
        limit = free_speed(roads.lanes[target], theirs, other["speed_factor"])
        net = gap - follower["half"] - half
        asked = accel_behind(theirs, pace, limit, net, row["speed"], kind["decel"])
        # A stopped or slow vehicle cannot brake for long, whatever the model returns.
        least = min(least, max(asked, -pace / BRAKE_TIME_S))
    return least


@kernel
def change_is_safe(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    target: int,
    own_wish: float,
    mandatory: bool,
    scratch: Scratch,
) -> bool:
    """Return whether MOBIL accepts that row i changes to lane `target`, and the gaps suffice."""
    row = rows[i]
    kind = travel.types[row["vtype"]]
    speed = row["speed"]
    half = 0.5 * row["length"]
    lane = roads.lanes[target]
    s = beside_s(roads, row["lane"], target, row["s"])
    if s >= roads.lanes[target]["length_m"]:
        return False  # the target lane has already ended
    desired = free_speed(roads.lanes[target], kind, row["speed_factor"])
    ahead = 0.0
    j = ahead_on(scratch, target, s, row["id"], travel.view_m)
    if j >= 0:
        ahead = scratch.entries[j]["s"] - s
    else:
        j, ahead = _next_beyond(roads, travel, row, target, lane["length_m"] - s, scratch)
        if _has_rear_close_beyond(scratch, lane, lane["length_m"] - s - half, kind["min_gap"]):
            return False
    after = wish(kind, speed, desired, no_constraint(kind))
    if j >= 0:
        leader = scratch.entries[j]
        net = ahead - half - leader["half"]
        # In a turn, a body extends further back than its rear position on the path.
        turns = s + ahead + leader["half"] > lane["length_m"]
        if net < (kind["min_gap"] if turns else SIDE_GAP_M):
            return False
        after = accel_behind(kind, speed, desired, net, leader["speed"], leader["decel"])
        # Krauss's model brakes over a whole reaction time, which is too little at low speed.
        faster = speed - leader["speed"] if kind["as_sumo"] else 0.0
        if faster > 0.0 and faster * faster > 2.0 * MAX_BRAKING_ACCEPTED * net:
            return False
    after = max(after, -speed / BRAKE_TIME_S)
    if after < -MAX_BRAKING_ACCEPTED:
        return False
    followers = imposed_on_followers(roads, travel, rows, row, target, s, scratch)
    most = MAX_BRAKING_NEEDED if mandatory else MAX_BRAKING_IMPOSED
    # With POLITENESS = 0 the present accelerations of the followers do not count.
    return mobil_accepts(own_wish, after, 0.0, followers, 0.0, 0.0, mandatory, most)


@inlined_kernel
def rear_is_inside(lane: np.void, row: np.void) -> bool:
    """Return whether a vehicle's rear is in or near the junction, where others may turn in.

    The result is False on lanes too short for two vehicles and room to swap: there, a vehicle waits
    with its rear in the junction (`lane_ends`), and would never change lanes.
    """
    room = SWAP_ROOM_M
    if not is_steered(row):
        room = MERGE_ROOM_M + LEAST_SWAP_M + LINE_MARGIN_M + LINE_SLACK_M
    spare = lane["length_m"] - 2.0 * row["length"] - room
    near_m = min(TURN_IN_M, max(spare - SPARE_M, 0.0))
    if is_steered(row) and row["speed"] < CREEP_MPS:
        near_m = 0.0  # the agent may have stopped there for the lane change
    inside: bool = spare > 0.0 and row["s"] < 0.5 * row["length"] + near_m
    return inside


@inlined_kernel
def _may_change(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    side: int,
    needed: int,
    own_wish: float,
    scratch: Scratch,
) -> bool:
    """Return whether row i wants to change to a side, for its route or speed, and can do so."""
    row = rows[i]
    lane = roads.lanes[row["lane"]]
    target = lane["left"] if side > 0 else lane["right"]
    if lane["internal"] or target < 0 or (needed != 0 and needed != side):
        return False
    if is_barred(roads, row["lane"], side, travel.types[row["vtype"]]["permissions"]):
        return False
    if is_closed(roads, target, travel.types[row["vtype"]]):
        return False
    if rear_is_inside(lane, row):
        return False
    rest = lane["length_m"] - row["s"] - SIDEWAYS_S * row["speed"]
    if rest < (0.5 * row["length"] if needed == 0 or row["speed"] > CREEP_MPS else 0.0):
        return False
    if needed == 0:
        if row["speed"] < MIN_SPEED_MPS or change_for_stop(roads, travel, row) == STAY:
            return False
        # Early exit: even on an empty lane the gain would be too small.
        kind = travel.types[row["vtype"]]
        desired = free_speed(roads.lanes[target], kind, row["speed_factor"])
        if wish(kind, row["speed"], desired, no_constraint(kind)) - own_wish < MIN_ACCEL_GAIN:
            return False
        beyond = travel.steps[row["way"] + target]
        if beyond["to_go"] == math.inf:
            return False
        # Do not change to a lane that leads to a turn that a steered car cannot take.
        turns = travel.steps[row["way"] + row["lane"]]["turnarounds"]
        if is_steered(row) and beyond["turnarounds"] > turns:
            return False
        early = (CHANGE_EARLY_M + CHANGE_EARLY_S * row["speed"]) * beyond["changes"]
        if beyond["change"] != 0:
            # The vehicle would have to return, behind the vehicles that are ahead of it now.
            queue_m = QUEUED_M * num_ahead(scratch, row["lane"], row["s"], row["id"], travel.view_m)
            if beyond["room"] - row["s"] - queue_m < 2.0 * early:
                return False
    if not change_is_safe(roads, travel, rows, i, target, own_wish, needed != 0, scratch):
        return False
    # A slow vehicle moves sideways almost in place.
    place = beside_s(roads, row["lane"], target, row["s"])
    slow: bool = row["speed"] < SLOW_MPS and not is_steered(row)
    return not slow or has_side_clearance(roads, rows, row, target, place, 0.0, side, scratch)


@inlined_kernel
def considers_lane_change(row: np.void, needed: int, tick: int, dt: float) -> bool:
    """Return whether a driver considers a lane change in this tick.

    Each driver considers each side once per LANE_CHANGE_DELAY_S, in ticks that depend on its id. A
    moving driver whose route needs the change considers it in every tick. Suggestions for agents
    are computed in every step.
    """
    if is_steered(row) or (needed != 0 and row["speed"] > 0.0):
        return True
    turns = max(1, round(0.5 * LANE_CHANGE_DELAY_S / dt))
    turn: bool = (tick // 2 + row["id"]) % turns == 0
    return turn


@inlined_kernel
def choose_lane(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    tick: int,
    needed: int,
    own_wish: float,
    scratch: Scratch,
) -> int:
    """Return the lane change of row i in this tick: 1 left, -1 right, 0 none.

    In even ticks background drivers may change only to the left, in odd ticks only to the right. So
    two vehicles never enter the same gap from both sides in one tick, whatever the order of rows.
    The rule does not apply to agents, because their suggestions are not binding.
    """
    row = rows[i]
    if is_steered(row):
        for side in (1, -1):
            if _may_change(roads, travel, rows, i, side, needed, own_wish, scratch):
                return side
        return 0
    side = 1 if tick % 2 == 0 else -1
    if row["side_lane"] < 0 and _may_change(
        roads, travel, rows, i, side, needed, own_wish, scratch
    ):
        return side
    return 0
