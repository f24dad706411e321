"""Which lane a driver wants, for its way or to drive faster, and whether it may change now.

The question is MOBIL's (`lane_change`); this file finds the vehicles concerned, and when a way
needs it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import DRIVER_AGENT
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
from cavmarl.driving.kernels.lanes.route_following import next_step
from cavmarl.driving.kernels.lanes.side_clearance import has_side_clearance
from cavmarl.driving.kernels.models.following import (
    LINE_MARGIN_M,
    accel_behind,
    no_constraint,
    wish,
)
from cavmarl.driving.kernels.motion.ordered_stops import STAY, change_for_stop

LOOK_BACK_M = 60.0  # how far back a lane change looks for followers
CHANGE_EARLY_M = 80.0  # a change that the route needs is made this far before it must be,
CHANGE_EARLY_S = 12.0  # plus the way of this time
MAX_BRAKING_ACCEPTED = 4.0  # m/s², harder braking behind the new leader is never worth it
MAX_BRAKING_NEEDED = 4.0  # m/s², what a change that the way needs may ask of the one behind
QUEUED_M = 7.5  # of lane that a vehicle takes in a queue
TURN_IN_M = 5.0  # behind a junction, where long vehicles still turn into the lanes beside,
SPARE_M = 2.0  # on lanes that are longer by this than what two that want to swap need
SLOW_MPS = 2.0  # with which one minds the corners of those that stand beside the lane it comes to
CREEP_MPS = 1.0  # so slow, a driver that has to change does so to the very end of its lane
SIDEWAYS_S = 2.5  # a lane change takes about this long, and has to end before the lane does
BRAKE_TIME_S = 0.5  # a braking that ends within this time is not felt
SIDE_GAP_M = 1.0  # m between bumpers, the least with which a lane change starts
# A driver that has to leave a lane waits this far before its end to change right, and a vehicle's
# length further back to change left: two that want to swap do not stand side by side for ever.
MERGE_ROOM_M = 2.0
SWAP_ROOM_M = 3.0
LEAST_SWAP_M = SIDE_GAP_M + 0.2  # of a background vehicle whose rear is in the junction otherwise
LINE_SLACK_M = 0.3  # so far before the place where it waits a vehicle may stand
MERGE_ROOM_SHARE = 0.25  # to the right at most this share of the lane's length


@inlined_kernel
def needed_change(roads: RoadArrays, travel: TripTables, row: np.void, step: np.void) -> int:
    """The side that a vehicle's way needs it to change to by now: 1 left, -1 right, 0 none.

    `step` is its own one.
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
def room_for_more(lane: np.void, row: np.void, step: np.void) -> float:
    """Where a steered vehicle changes lanes more than once, room for all changes but the first."""
    further = (step["changes"] - 1) * (row["length"] + SWAP_ROOM_M)
    return float(min(further, max(MERGE_ROOM_SHARE * lane["length_m"] - MERGE_ROOM_M, 0.0)))


@inlined_kernel
def _desired(roads: RoadArrays, kind: np.void, row: np.void, lane: int) -> float:
    """The speed in m/s that a driver wants on a lane."""
    limit = min(roads.lanes[lane]["speed_mps"], kind["desired_max_speed"])
    return float(min(limit * row["speed_factor"], kind["max_speed"]))


@kernel
def wish_on_lane(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    k: int,  # its entry
    scratch: Scratch,
) -> float:
    """The acceleration in m/s² that a steered vehicle would like of its lane and its leader there.

    What it slows down for on either lane, bends, lines and limits ahead, is no reason to change.
    """
    lane = row["lane"]
    kind = travel.types[row["vtype"]]
    desired = _desired(roads, kind, row, lane)
    # Beyond the view a leader may be another zone's, and not known here.
    follows = (
        k + 1 < scratch.lane_end[lane] and scratch.entries[k + 1]["s"] - row["s"] <= travel.view_m
    )
    if not follows:
        return wish(kind, row["speed"], desired, no_constraint(kind))
    leader = scratch.entries[k + 1]
    gap = leader["s"] - row["s"] - 0.5 * row["length"] - leader["half"]
    return accel_behind(kind, row["speed"], desired, gap, leader["speed"], leader["decel"])


@inlined_kernel
def _is_left_slowly(scratch: Scratch, lane: np.void, front: float, gap_m: float) -> bool:
    """Whether a rear before the end of a lane, wherever it goes, is within a gap.

    `front`: how far that end is ahead.
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
    """The entry of the next vehicle behind the end of a lane, and how far ahead its centre is.

    `far`: how far that end is ahead. It looks as far as over a junction and onto the lane behind
    it; -1 and as far as it has looked: there is none.
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
def asked_of_followers(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    row: np.void,
    target: int,
    s: float,
    scratch: Scratch,
) -> float:
    """The least acceleration in m/s² that a change to place `s` of `target` asks of a follower.

    -inf where one is beside that place. A far one that is fast may have to brake harder than a near
    one that stands: every lane that leads there is asked.
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
        limit = _desired(roads, theirs, other, target)
        net = gap - follower["half"] - half
        asked = accel_behind(theirs, pace, limit, net, row["speed"], kind["decel"])
        # A standing or creeping vehicle cannot brake for long, whatever the model answers.
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
    """MOBIL's question for row i and lane `target`, with the gaps that it takes for granted."""
    row = rows[i]
    kind = travel.types[row["vtype"]]
    speed = row["speed"]
    half = 0.5 * row["length"]
    lane = roads.lanes[target]
    s = beside_s(roads, row["lane"], target, row["s"])
    if s >= roads.lanes[target]["length_m"]:
        return False  # it has ended beside
    desired = _desired(roads, kind, row, target)
    ahead = 0.0
    j = ahead_on(scratch, target, s, row["id"], travel.view_m)
    if j >= 0:
        ahead = scratch.entries[j]["s"] - s
    else:
        j, ahead = _next_beyond(roads, travel, row, target, lane["length_m"] - s, scratch)
        if _is_left_slowly(scratch, lane, lane["length_m"] - s - half, kind["min_gap"]):
            return False
    after = wish(kind, speed, desired, no_constraint(kind))
    if j >= 0:
        leader = scratch.entries[j]
        net = ahead - half - leader["half"]
        # In a turn a body sticks out behind the place of its rear on its way.
        turns = s + ahead + leader["half"] > lane["length_m"]
        if net < (kind["min_gap"] if turns else SIDE_GAP_M):
            return False
        after = accel_behind(kind, speed, desired, net, leader["speed"], leader["decel"])
        # Krauss's answers for a reaction time, and asks for less than it takes at a crawl.
        faster = speed - leader["speed"] if kind["as_sumo"] else 0.0
        if faster > 0.0 and faster * faster > 2.0 * MAX_BRAKING_ACCEPTED * net:
            return False
    after = max(after, -speed / BRAKE_TIME_S)
    if after < -MAX_BRAKING_ACCEPTED:
        return False
    followers = asked_of_followers(roads, travel, rows, row, target, s, scratch)
    most = MAX_BRAKING_NEEDED if mandatory else MAX_BRAKING_IMPOSED
    # What followers gain or lose has no weight (POLITENESS), so what they do now is not asked.
    return mobil_accepts(own_wish, after, 0.0, followers, 0.0, 0.0, mandatory, most)


@inlined_kernel
def rear_is_inside(lane: np.void, row: np.void) -> bool:
    """Whether a vehicle's rear is in the junction or near it, where others turn in beside it.

    On lanes so short that two do not fit behind one another, with room to swap, that does not
    count: a vehicle waits to change with its rear inside (`lane_ends`), and would never change.
    """
    room = SWAP_ROOM_M
    if row["driver"] != DRIVER_AGENT:
        room = MERGE_ROOM_M + LEAST_SWAP_M + LINE_MARGIN_M + LINE_SLACK_M
    spare = lane["length_m"] - 2.0 * row["length"] - room
    near_m = min(TURN_IN_M, max(spare - SPARE_M, 0.0))
    if row["driver"] == DRIVER_AGENT and row["speed"] < CREEP_MPS:
        near_m = 0.0  # it may have stopped there for the change itself
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
    """Whether row i wants to and can change to one side: for its way, or to drive faster."""
    row = rows[i]
    lane = roads.lanes[row["lane"]]
    target = lane["left"] if side > 0 else lane["right"]
    if lane["internal"] or target < 0 or (needed != 0 and needed != side):
        return False
    if rear_is_inside(lane, row):
        return False
    rest = lane["length_m"] - row["s"] - SIDEWAYS_S * row["speed"]
    if rest < (0.5 * row["length"] if needed == 0 or row["speed"] > CREEP_MPS else 0.0):
        return False
    if needed == 0:
        if row["speed"] < 1.0 or change_for_stop(roads, travel, row) == STAY:
            return False
        # Not even an empty lane would be worth it.
        kind = travel.types[row["vtype"]]
        desired = _desired(roads, kind, row, target)
        if wish(kind, row["speed"], desired, no_constraint(kind)) - own_wish < MIN_ACCEL_GAIN:
            return False
        beyond = travel.steps[row["way"] + target]
        if beyond["to_go"] == math.inf:
            return False
        # What is won is not worth a turn that a steered car cannot take.
        turns = travel.steps[row["way"] + row["lane"]]["turnarounds"]
        if row["driver"] == DRIVER_AGENT and beyond["turnarounds"] > turns:
            return False
        early = (CHANGE_EARLY_M + CHANGE_EARLY_S * row["speed"]) * beyond["changes"]
        if beyond["change"] != 0:
            # Back into its own lane it gets behind those that are on it now.
            queue_m = QUEUED_M * num_ahead(scratch, row["lane"], row["s"], row["id"], travel.view_m)
            if beyond["room"] - row["s"] - queue_m < 2.0 * early:
                return False
    if not change_is_safe(roads, travel, rows, i, target, own_wish, needed != 0, scratch):
        return False
    # One that is so slow goes sideways where it is.
    place = beside_s(roads, row["lane"], target, row["s"])
    slow: bool = row["speed"] < SLOW_MPS and row["driver"] != DRIVER_AGENT
    return not slow or has_side_clearance(roads, rows, row, target, place, 0.0, side, scratch)


@inlined_kernel
def thinks_of_lanes(row: np.void, needed: int, tick: int, dt: float) -> bool:
    """Whether a driver thinks of a lane change in this tick.

    Each does so once in LANE_CHANGE_DELAY_S for either side, not all in the same ticks; always, if
    its way needs the change and it does not stand. A suggestion for an agent is made anew at each
    step.
    """
    if row["driver"] == DRIVER_AGENT or (needed != 0 and row["speed"] > 0.0):
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
    """The lane change that row i makes now: 1 left, -1 right, 0 none.

    In even ticks background drivers may only change to the left, in odd ones to the right: two of
    them never take the same gap from both sides in one tick, whichever is asked first. A suggestion
    for an agent is not binding, so it has no such rule.
    """
    row = rows[i]
    if row["driver"] == DRIVER_AGENT:
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
