"""Right of way: whether a driver may enter a link, or go on from a waiting position inside.

A driver enters a link if no foe is in the shared area when it would be, if it gives way to those it
must give way to, and if there is room behind the junction. Where the map lets drivers wait inside
the junction (for oncoming traffic before a left turn), what lies beyond that place is asked there.
All questions are minima and any-ofs over the foes: the order of rows plays no part.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
    SIGNAL_GREEN_MAJOR,
    SIGNAL_OFF,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.core.records.rows import WAIT_SLACK_M
from cavmarl.driving.kernels.junctions.deadlocks import resolves_deadlocks, yields_in_deadlock
from cavmarl.driving.kernels.junctions.gaps import (
    ROOM_M,
    STOOD_S,
    STOP_SIGN_S,
    foe_blocks,
    is_minor,
    link_signal,
    must_stop,
    stays_inside,
)
from cavmarl.driving.kernels.junctions.stop_line_registration import STANDING_MPS
from cavmarl.driving.kernels.junctions.swept_areas import MOST_BACK_M, wait_place
from cavmarl.driving.kernels.lanes.route_following import next_step
from cavmarl.driving.kernels.models.following import (
    LINE_MARGIN_M,
    before_line,
    behind,
    no_constraint,
)

# m/s², a driver stops for yellow where this braking is enough; Krauss's brakes as hard as it can
COMFORT_STOP = 3.0
STEERED_MPS = 5.0  # a steered car is taken to turn no faster than this
SEE_FOES_M = 4.5  # before a line, a driver that gives way is ready to stop, as SUMO's are
LAST_CHANCE_M = 3.0  # with the front this near to the line
STUB_LANES = 4  # looked along for a stop sign
EXIT_LANES = 4  # looked along for room,
EXIT_LOOK_M = 75.0  # and no further than this: ten cars stand there
CREPT_M = 2.4  # a steered car whose front is so little beyond a red line,
CREPT_MPS = 2.0  # and that is so slow, stays there;
INSIDE_M = 1.0  # nearer to a waiting position inside it may be one that waits there
STOP_LINE_M = 5.0  # standing with the front nearer than this counts as standing at the line,
# and in an agent's seat nearer than this: it may wait so far before it, and with some slack
STOP_SIGN_M = MOST_BACK_M + 2.0 * LINE_MARGIN_M


@kernel
def _blocked_by_foes(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    link: int,
    distance: float,
    wait_m: float,
    inside: bool,
    gives_way: bool,
    phase: NDArray[np.int32],
    scratch: Scratch,
) -> int:
    """Whether a foe is, or will be, where row i would be on `link`, `distance` m from its line.

    Asks about the shared areas before `wait_m`, or, from `inside`, about those beyond. One that
    stands and would have to drive over another that stays there is blocked (HOLD_EXIT_BLOCKED),
    whatever else it gives way to (HOLD_YIELD): it will not come.
    """
    row = rows[i]
    hold = HOLD_NONE
    limit = roads.lanes[roads.links[link]["next_lane"]]["speed_mps"]
    if row["driver"] == DRIVER_AGENT:
        limit = min(limit, STEERED_MPS)
    equal = resolves_deadlocks(roads, travel, row, link)
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        begin = scratch.link_start[conflict["foe"]]
        end = scratch.link_end[conflict["foe"]]
        if begin == end or (conflict["enter_m"] >= wait_m - LINE_MARGIN_M) != inside:
            continue
        for k in range(begin, end):
            foe = scratch.approach[k]
            if foe["row"] == i:
                continue
            other = rows[foe["row"]]
            both = equal and resolves_deadlocks(roads, travel, other, conflict["foe"])
            waits = both and conflict["must_yield"] and foe["dist"] > foe["half"]
            if waits and yields_in_deadlock(roads, rows, other, conflict["foe"], row, scratch):
                continue
            found = foe_blocks(
                roads,
                travel,
                rows,
                row,
                link,
                distance,
                limit,
                conflict,
                foe,
                gives_way,
                phase,
                both,
            )
            if found == HOLD_NONE:
                continue
            if row["speed"] > STANDING_MPS:
                return HOLD_YIELD
            if found == HOLD_EXIT_BLOCKED:
                return HOLD_EXIT_BLOCKED
            hold = HOLD_YIELD
    return hold


@kernel
def exit_blocked(
    roads: RoadArrays, travel: TripTables, row: np.void, link: int, way: int, scratch: Scratch
) -> bool:
    """Whether a row could not clear the junction behind the last standing vehicle on its way.

    Vehicles still moving in between need room as well. Not counted: vehicles more than
    `EXIT_LOOK_M` beyond the junction.
    """
    target = roads.links[link]
    room = 0.0
    lane = target["next_lane"]
    while roads.lanes[lane]["internal"]:
        for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
            other = scratch.entries[k]
            if other["id"] != row["id"]:
                room -= 2.0 * other["half"] + ROOM_M
        lane = roads.lanes[lane]["successor"]
    needed = row["length"] + ROOM_M
    beyond = 0.0
    for _ in range(EXIT_LANES):
        for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
            other = scratch.entries[k]
            if beyond + other["s"] > EXIT_LOOK_M:
                return False
            if other["speed"] < STANDING_MPS:
                room += other["s"] - other["half"]
                blocked: bool = room < needed
                return blocked
            room -= 2.0 * other["half"] + ROOM_M
        room += roads.lanes[lane]["length_m"]
        beyond += roads.lanes[lane]["length_m"]
        if room >= needed or beyond > EXIT_LOOK_M:
            return False
        lane, way, _ = next_step(roads, travel, lane, way)
        if lane < 0:
            return False
    return False


@kernel
def may_enter(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,)
    i: int,  # the row that asks
    link: int,  # LINK row
    distance: float,  # of its centre to the end of its lane in m
    way: int,  # of the row beyond the junction
    phase: NDArray[np.int32],  # (num_signals,) PHASE rows that are on
    scratch: Scratch,  # with the lane and link indices of this tick
) -> int:
    """Whether row i may drive into `link`: HOLD_NONE, or why it has to stop at the line."""
    row = rows[i]
    signal = link_signal(roads, link, phase)
    back = roads.lanes[roads.links[link]["from_lane"]]["stop_back_m"]
    front = max(distance - 0.5 * row["length"] - back, 0.01)
    needed = row["speed"] * row["speed"] / (2.0 * front)
    if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
        return HOLD_SIGNAL
    kind = travel.types[row["vtype"]]
    stops = kind["decel"] if kind["as_sumo"] else COMFORT_STOP
    if (signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR) and needed < stops:
        # A vehicle that gave way at the line all through green goes now, as the others stop.
        if row["hold"] != HOLD_YIELD or front > LAST_CHANCE_M:
            return HOLD_SIGNAL
    target = roads.links[link]
    if target["num_conflicts"] == 0:
        return HOLD_NONE
    stands = row["driver"] != DRIVER_AGENT and row["wait_s"] >= STOOD_S and front < STOP_LINE_M
    if must_stop(roads, link, signal) and row["stopped_at"] != link and not stands:
        return HOLD_YIELD
    resolves = resolves_deadlocks(roads, travel, row, link)
    if resolves and yields_in_deadlock(roads, rows, row, link, row, scratch):
        return HOLD_YIELD
    gives_way = signal != SIGNAL_GREEN_MAJOR and signal != SIGNAL_OFF
    hold = _blocked_by_foes(
        roads, travel, rows, i, link, distance, target["wait_m"], False, gives_way, phase, scratch
    )
    if hold != HOLD_NONE:
        return hold
    if exit_blocked(roads, travel, row, link, way, scratch):
        return HOLD_EXIT_BLOCKED
    return HOLD_NONE


@inlined_kernel
def has_crept(
    roads: RoadArrays,
    row: np.void,  # VEHICLE
    link: int,  # LINK row
    over_m: float,  # of its front beyond the line
    phase: NDArray[np.int32],  # (num_signals,) PHASE rows that are on
) -> bool:
    """Whether an agent's vehicle that stood at a red line has crept over it, and stays there."""
    if row["driver"] != DRIVER_AGENT or row["speed"] > CREPT_MPS:
        return False
    if over_m >= min(CREPT_M, roads.links[link]["wait_m"] - INSIDE_M):
        return False
    signal = link_signal(roads, link, phase)
    red: bool = signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW
    return red


@kernel
def note_stop(
    roads: RoadArrays,
    plans: NDArray[np.void],
    row: np.void,  # VEHICLE of an agent before its tick; stopped_at is written
    phase: NDArray[np.int32],  # (num_signals,) PHASE rows that are on
) -> None:
    """Note before which stop sign an agent's vehicle has stood, until it leaves that lane.

    Where the lane before the sign is short the vehicle stands on one before that.
    """
    lane = row["lane"]
    to_end = -row["s"] - 0.5 * row["length"]
    noted = -1
    for _ in range(STUB_LANES):
        here, step = roads.lanes[lane], plans[row["goal"], lane]
        to_end += here["length_m"]
        if row["stopped_at"] >= 0 and roads.links[row["stopped_at"]]["from_lane"] == lane:
            noted = row["stopped_at"]
        to_line = to_end - here["stop_back_m"]
        link = step["link"] if not here["internal"] and row["wait_s"] >= STOP_SIGN_S else -1
        if link >= 0 and to_line < STOP_SIGN_M:
            if must_stop(roads, link, link_signal(roads, link, phase)):
                noted = link
                break
        lane = step["next"]
        if noted >= 0 or lane < 0 or to_end > STOP_SIGN_M:
            break
    row["stopped_at"] = noted


@kernel
def behind_merging(
    roads: RoadArrays,
    kind: np.void,
    row: np.void,
    link: int,  # that it takes next
    distance: float,  # of its centre to the end of its lane in m
    scratch: Scratch,
) -> float:
    """The constraint of those that are on the junction on their way into the same lane.

    They come slowly out of a turn: one that is fast brakes early.
    """
    constraint = no_constraint(kind)
    front = 0.5 * row["length"] - distance
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        if not conflict["merging"]:
            continue
        for k in range(scratch.link_start[conflict["foe"]], scratch.link_end[conflict["foe"]]):
            foe = scratch.approach[k]
            foe_front = foe["half"] - foe["dist"]
            rear = -foe["half"] - foe["dist"]
            wait_m = roads.links[foe["link"]]["wait_m"]
            waits = foe_front <= wait_m < conflict["foe_enter_m"] + LINE_MARGIN_M
            if foe_front <= 0.0 or rear > conflict["foe_leave_m"] or waits:
                continue
            if foe["speed"] > STANDING_MPS:
                gap = (conflict["leave_m"] - front) - (conflict["foe_leave_m"] - rear)
                gap = max(gap, conflict["enter_m"] - front)
                found = behind(kind, row["speed"], gap, foe["speed"], kind["decel"])
                constraint = max(constraint, found)
    return constraint


@kernel
def waits_inside(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    link: int,
    distance: float,
    way: int,
    phase: NDArray[np.int32],
    scratch: Scratch,
) -> int:
    """Whether row i has to stop at the waiting position of `link`, if there is one: HOLD_*.

    Arguments as in `may_enter`; the distance is negative inside.
    """
    wait_m = roads.links[link]["wait_m"]
    if wait_m == math.inf:
        return HOLD_NONE
    signal = link_signal(roads, link, phase)
    gives_way = signal != SIGNAL_GREEN_MAJOR and signal != SIGNAL_OFF
    hold = _blocked_by_foes(
        roads, travel, rows, i, link, distance, wait_m, True, gives_way, phase, scratch
    )
    if hold != HOLD_NONE:
        return hold
    if exit_blocked(roads, travel, rows[i], link, way, scratch):
        return HOLD_EXIT_BLOCKED
    return HOLD_NONE


@inlined_kernel
def before_waiting(
    roads: RoadArrays,
    kind: np.void,
    row: np.void,
    link: int,
    place: float,  # of its front, m beyond its stop line
    waits: int,  # why it stops at the waiting position inside, HOLD_*
    minor: bool,  # whether it comes to that ready to stop, as SUMO's do that give way
    dt: float,
) -> float:
    """The constraint of the waiting position inside."""
    to_wait = wait_place(roads, link, 0.5 * row["length"]) - place
    if waits == HOLD_NONE:
        if not minor or to_wait <= SEE_FOES_M:
            return no_constraint(kind)
        to_wait += LINE_MARGIN_M
    return before_line(kind, row["speed"], to_wait, dt)


@kernel
def constraint_inside(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,)
    i: int,  # the row that asks
    link: int,  # that it drives on
    place: float,  # of its centre, m beyond the end of the lane that it comes from
    way: int,  # of the row beyond the junction
    phase: NDArray[np.int32],  # (num_signals,) PHASE rows that are on
    dt: float,  # seconds a tick
    scratch: Scratch,  # with the lane and link indices of this tick
) -> tuple[float, int, int]:
    """The constraint of foes on the same junction on row i, whose front is beyond its stop line.

    Of two vehicles in conflict the one that is nearer to the shared area goes first; at equal
    distance the smaller id. Where both lead into one lane, the other follows it there. At a
    waiting position inside, row i waits until it may go on.

    Returns:
        The constraint; why it cannot go on (HOLD_*), be it that one which stays there is in its
        way; and why it has to stop at the waiting position alone.
    """
    row = rows[i]
    kind = travel.types[row["vtype"]]
    half = 0.5 * row["length"]
    front = place + half
    constraint, waits = no_constraint(kind), HOLD_NONE
    target = roads.links[link]
    if target["wait_m"] < math.inf and front <= target["wait_m"] + WAIT_SLACK_M:
        waits = waits_inside(roads, travel, rows, i, link, -place, way, phase, scratch)
        minor = kind["as_sumo"] and is_minor(roads, link, phase)
        constraint = before_waiting(roads, kind, row, link, front, waits, minor, dt)
    hold = waits
    first = target["first_conflict"]
    for c in range(first, first + target["num_conflicts"]):
        conflict = roads.conflicts[c]
        if place - half > conflict["leave_m"] or not conflict["near"]:
            continue
        for k in range(scratch.link_start[conflict["foe"]], scratch.link_end[conflict["foe"]]):
            foe = scratch.approach[k]
            if foe["row"] == i:
                continue
            found = _constraint_of(roads, rows, kind, row, conflict, foe, place, dt)
            if found > no_constraint(kind):
                constraint = max(constraint, found)
                if hold == HOLD_NONE and stays_inside(rows[foe["row"]]):
                    hold = HOLD_EXIT_BLOCKED
    return constraint, hold, waits


@kernel
def _constraint_of(
    roads: RoadArrays,
    rows: NDArray[np.void],
    kind: np.void,
    row: np.void,
    conflict: np.void,
    foe: np.void,
    place: float,
    dt: float,
) -> float:
    """Constraint of one APPROACH on a row on the same junction, `place` m beyond its stop line."""
    half = 0.5 * row["length"]
    front = place + half
    foe_front = foe["half"] - foe["dist"]
    foe_rear = -foe["half"] - foe["dist"]
    wait_m = roads.links[foe["link"]]["wait_m"]
    other = rows[foe["row"]]
    stops = foe["speed"] < STANDING_MPS
    if row["driver"] != DRIVER_AGENT and other["driver"] != DRIVER_AGENT:
        stops |= other["hold"] == HOLD_YIELD
    waits = (
        foe_front <= wait_m + WAIT_SLACK_M
        and conflict["foe_enter_m"] >= wait_m - LINE_MARGIN_M
        and stops
    )
    if foe_front <= 0.0 or foe_rear > conflict["foe_leave_m"] or waits:
        return no_constraint(kind)
    to_area = conflict["enter_m"] - front
    foe_to_area = conflict["foe_enter_m"] - foe_front
    # How much further the one has to go to be out of the shared area than the other's rear.
    gap = (conflict["leave_m"] - front) - (conflict["foe_leave_m"] - foe_rear)
    if to_area >= 0.0:
        if foe_to_area > to_area or (foe_to_area == to_area and foe["id"] > row["id"]):
            return no_constraint(kind)
        if conflict["merging"] and gap > to_area:
            return behind(kind, row["speed"], gap, foe["speed"], kind["decel"])
        return before_line(kind, row["speed"], to_area, dt)
    # Both are in it side by side: the one nearer to its end goes on, the other stays behind.
    if foe_to_area > 0.0:
        return no_constraint(kind)
    rest = conflict["leave_m"] - front
    foe_rest = conflict["foe_leave_m"] - foe_front
    if foe_rest > rest or (foe_rest == rest and foe["id"] > row["id"]):
        return no_constraint(kind)
    return behind(kind, row["speed"], gap, foe["speed"], kind["decel"])
