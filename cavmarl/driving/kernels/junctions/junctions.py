"""Right of way: whether a driver may enter a link, or leave a waiting position inside a junction.

A driver enters a link if no foe occupies the shared area at the same time, if the driver yields to
no foe with the right of way, and if there is room after the junction. Some links have a waiting
position inside the junction, for example for oncoming traffic before a left turn. Foes beyond that
position are checked there and not at the stop line. All results are minima or disjunctions over the
foes, so the order of rows does not matter.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import (
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
    SIGNAL_GREEN_MAJOR,
    SIGNAL_NONE,
    SIGNAL_OFF,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.core.records.rows import WAIT_SLACK_M, is_steered
from cavmarl.driving.kernels.junctions.deadlocks import resolves_deadlocks, yields_in_deadlock
from cavmarl.driving.kernels.junctions.gaps import (
    HARD_STOP,
    ROOM_M,
    STOOD_S,
    STOP_SIGN_S,
    hold_for_foe,
    is_minor,
    link_signal,
    must_stop,
    stays_inside,
)
from cavmarl.driving.kernels.junctions.stop_line_registration import IMPATIENT_S, STANDING_MPS
from cavmarl.driving.kernels.junctions.swept_areas import MOST_BACK_M, wait_place
from cavmarl.driving.kernels.junctions.zippers import is_zipper, passes_first
from cavmarl.driving.kernels.lanes.route_following import next_step
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M
from cavmarl.driving.kernels.models.following import before_line, behind, no_constraint
from cavmarl.roads.kernels.lanes_now import is_closed

# m/s²: a driver stops at yellow if this deceleration suffices. Drivers with a model of SUMO stop if
# their full deceleration suffices.
COMFORT_STOP = 3.0
STEERED_MPS = 5.0  # assumed top speed of a steered car in a turn
SEE_FOES_M = 4.5  # as in SUMO, a driver that yields stays ready to stop until it is this close
LAST_CHANCE_M = 3.0  # a driver that has yielded and is this close to the line still goes at yellow
STUB_LANES = 4  # number of lanes ahead that are searched for a stop sign
EXIT_LANES = 4  # number of lanes behind a junction that are searched for room
EXIT_LOOK_M = 75.0  # largest distance of that search: room for ten cars
SWAP_TICKS = 64  # two vehicles that wait for room on each other's lane take turns of this length
# A steered car that is slower than `CREPT_MPS` and at most `CREPT_M` beyond a red line stays there.
CREPT_M = 2.4
CREPT_MPS = 2.0
INSIDE_M = 1.0  # closer than this to a waiting position, a vehicle may be waiting there
STOP_LINE_M = 5.0  # a stopped vehicle whose front is closer than this is at the line
# The same with some slack for agents' vehicles, which may have to wait further back.
STOP_SIGN_M = MOST_BACK_M + 2.0 * LINE_MARGIN_M


@kernel
def _hold_for_foes(
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
    """Return the reason (HOLD_*) why foes keep row i out of `link`; its line is `distance` m ahead.

    If `inside`, the shared areas beyond the waiting position at `wait_m` are checked, else the
    areas before it. For a stopped vehicle, HOLD_EXIT_BLOCKED (a foe stays in the way) has priority
    over HOLD_YIELD: other drivers need not wait for a vehicle that cannot go.
    """
    row = rows[i]
    hold = HOLD_NONE
    limit = roads.lanes[roads.links[link]["next_lane"]]["speed_mps"]
    if is_steered(row):
        limit = min(limit, STEERED_MPS)
    equal = resolves_deadlocks(roads, travel, row, link)
    zipper, front = is_zipper(roads, link), distance - 0.5 * row["length"]
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        begin = scratch.link_start[conflict["foe"]]
        end = scratch.link_end[conflict["foe"]]
        if begin == end or (conflict["enter_m"] >= wait_m - LINE_MARGIN_M) != inside:
            continue
        in_turn = zipper and is_zipper(roads, conflict["foe"])
        if in_turn and conflict["merging"]:
            continue  # the driver follows the foes that pass first, see `zippers`
        for k in range(begin, end):
            foe = scratch.approach[k]
            if foe["row"] == i:
                continue
            if in_turn and not passes_first(roads, travel, rows, row, link, front, foe):
                continue
            other = rows[foe["row"]]
            both = equal and resolves_deadlocks(roads, travel, other, conflict["foe"])
            waits = both and conflict["must_yield"] and foe["dist"] > foe["half"]
            if waits and yields_in_deadlock(roads, rows, other, conflict["foe"], row, scratch):
                continue
            found = hold_for_foe(
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


@inlined_kernel
def _stops_all(signal: int) -> bool:
    """Return whether a signal is red or yellow, so that it stops all vehicles one junction away."""
    red = signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW
    return red or signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR


@kernel
def _waits_at(
    roads: RoadArrays, link: int, road_m: float, needed: float, phase: NDArray[np.int32]
) -> bool:
    """Return whether a vehicle must expect to wait before `link`, beyond the next junction.

    The vehicle may have to wait at red and yellow, and where it yields during green. But if the
    road before `link`, `road_m` m long, has no room for the vehicle, it cannot wait there for
    others. At links without a signal it expects to go, as in SUMO.
    """
    signal = link_signal(roads, link, phase)
    yields = signal != SIGNAL_NONE and (
        must_stop(roads, link, signal) or is_minor(roads, link, phase)
    )
    waits: bool = _stops_all(signal) or (yields and road_m >= needed)
    return waits


@kernel
def _room_inside(roads: RoadArrays, link: int, phase: NDArray[np.int32], scratch: Scratch) -> float:
    """Return how far beyond its line a vehicle that yields on `link` can wait, in m.

    The result is 0 if the vehicle has to wait at the line: at red and yellow, if there is no
    waiting position inside, and if another vehicle is on the way there.
    """
    lane, wait_m = roads.links[link]["next_lane"], roads.links[link]["wait_m"]
    taken = scratch.lane_start[lane] < scratch.lane_end[lane]
    if _stops_all(link_signal(roads, link, phase)) or wait_m == np.inf or taken:
        return 0.0
    room: float = wait_m
    return room


@inlined_kernel
def _is_road(roads: RoadArrays, lane: int) -> bool:
    """Return whether vehicles may stop on a lane: outside of junctions, or where no paths meet."""
    here = roads.lanes[lane]
    if not here["internal"]:
        return True
    path = roads.links[here["link"]]
    is_alone: bool = path["num_conflicts"] == 0 and path["num_sweeps"] == 0
    return is_alone


@inlined_kernel
def _goes_first_in_swap(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,  # VEHICLE
    link: int,  # next LINK of the row
    other: np.void,  # VEHICLE stopped on the road beyond, without room for the row behind it
    room: float,  # free distance behind that vehicle, m
) -> bool:
    """Return whether a row enters a junction without room beyond, to swap places with `other`.

    Two vehicles that wait for room on each other's lane would wait forever. One of them goes and
    stops inside the junction, if it then clears its own lane. They take turns to try.
    """
    if other["hold"] != HOLD_EXIT_BLOCKED or other["wait_s"] <= IMPATIENT_S:
        return False
    if (row["id"] < other["id"]) != (row["tick"] // SWAP_TICKS % 2 == 0):
        return False
    if room + roads.links[link]["length_m"] < row["length"] + ROOM_M:
        return False
    if roads.lanes[other["lane"]]["internal"]:
        return False
    _, _, back = next_step(roads, travel, other["lane"], other["way"])
    swaps: bool = back >= 0 and roads.links[back]["to_lane"] == roads.links[link]["from_lane"]
    return swaps


@kernel
def exit_blocked(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,)
    row: np.void,  # VEHICLE
    link: int,  # next LINK of the row
    way: int,  # the row's `way` beyond the junction
    phase: NDArray[np.int32],  # (num_signals,) active PHASE rows
    scratch: Scratch,
) -> bool:
    """Return whether a row could not clear the junction because of the next vehicle waiting ahead.

    Vehicles that move in between need room as well. The room ends at the next line at which a
    vehicle on that road, or the row itself, has to wait. The inside of a junction does not count as
    room, except up to a free waiting position, and on a path that meets no other path. Vehicles
    more than `EXIT_LOOK_M` beyond the junction do not count.
    """
    target = roads.links[link]
    if target["may_block"]:
        return False
    room = 0.0
    lane = target["next_lane"]
    while roads.lanes[lane]["internal"]:
        for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
            other = scratch.entries[k]
            if other["id"] != row["id"]:
                room -= 2.0 * other["half"] + ROOM_M
        lane = roads.lanes[lane]["successor"]
    needed = row["length"] + ROOM_M
    beyond, road_m = 0.0, 0.0
    for _ in range(EXIT_LANES):
        waits = False
        for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
            other = scratch.entries[k]
            if beyond + other["s"] > EXIT_LOOK_M:
                return False
            if other["speed"] < STANDING_MPS:
                room += other["s"] - other["half"]
                if room >= needed:
                    return False
                stands = rows[other["row"]]
                blocked: bool = not _goes_first_in_swap(roads, travel, row, link, stands, room)
                return blocked
            waits |= rows[other["row"]]["hold"] != HOLD_NONE
            room -= 2.0 * other["half"] + ROOM_M
        beyond += roads.lanes[lane]["length_m"]
        if _is_road(roads, lane):
            road_m += roads.lanes[lane]["length_m"]
            room += roads.lanes[lane]["length_m"]
        if room >= needed or beyond > EXIT_LOOK_M:
            return False
        if waits:
            return True
        lane, way, ahead = next_step(roads, travel, lane, way)
        if lane < 0:
            return False
        if ahead >= 0 and _waits_at(roads, ahead, road_m, needed, phase):
            full: bool = room + _room_inside(roads, ahead, phase, scratch) < needed
            return full
    return False


@kernel
def hold_at_line(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,)
    i: int,  # row of the vehicle
    link: int,  # LINK row
    distance: float,  # from the vehicle's centre to the end of its lane, m
    way: int,  # the vehicle's `way` beyond the junction
    phase: NDArray[np.int32],  # (num_signals,) active PHASE rows
    scratch: Scratch,  # with the lane and link indices of this tick
) -> int:
    """Return HOLD_NONE if row i may enter `link`, else the reason to stop at the line (HOLD_*)."""
    row = rows[i]
    signal = link_signal(roads, link, phase)
    back = roads.lanes[roads.links[link]["from_lane"]]["stop_back_m"]
    front = max(distance - 0.5 * row["length"] - back, 0.01)
    needed = row["speed"] * row["speed"] / (2.0 * front)
    if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
        return HOLD_SIGNAL
    kind = travel.types[row["vtype"]]
    if is_closed(roads, roads.links[link]["to_lane"], kind) and needed <= HARD_STOP:
        return HOLD_EXIT_BLOCKED
    stops = kind["decel"] if kind["as_sumo"] else COMFORT_STOP
    if (signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR) and needed < stops:
        # A vehicle that yielded at the line during green goes now, because the other vehicles stop.
        if row["hold"] != HOLD_YIELD or front > LAST_CHANCE_M:
            return HOLD_SIGNAL
    target = roads.links[link]
    if target["num_conflicts"] == 0:
        return HOLD_NONE
    stands = not is_steered(row) and row["wait_s"] >= STOOD_S and front < STOP_LINE_M
    if must_stop(roads, link, signal) and row["stopped_at"] != link and not stands:
        return HOLD_YIELD
    resolves = resolves_deadlocks(roads, travel, row, link)
    if resolves and yields_in_deadlock(roads, rows, row, link, row, scratch):
        return HOLD_YIELD
    gives_way = signal != SIGNAL_GREEN_MAJOR and signal != SIGNAL_OFF
    hold = _hold_for_foes(
        roads, travel, rows, i, link, distance, target["wait_m"], False, gives_way, phase, scratch
    )
    if hold != HOLD_NONE:
        return hold
    if needed <= HARD_STOP and exit_blocked(roads, travel, rows, row, link, way, phase, scratch):
        return HOLD_EXIT_BLOCKED
    return HOLD_NONE


@inlined_kernel
def has_crept_over_red(
    roads: RoadArrays,
    row: np.void,  # VEHICLE
    link: int,  # LINK row
    over_m: float,  # distance of the front beyond the line, m
    phase: NDArray[np.int32],  # (num_signals,) active PHASE rows
) -> bool:
    """Return whether an agent's vehicle has crept over the line at red and has to stay there."""
    if not is_steered(row) or row["speed"] > CREPT_MPS:
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
    row: np.void,  # VEHICLE of an agent before the tick; `stopped_at` is written
    phase: NDArray[np.int32],  # (num_signals,) active PHASE rows
) -> None:
    """Record the stop sign at which an agent's vehicle has stopped; leaving the lane clears it.

    If the lane before the sign is short, the vehicle may have stopped on a previous lane.
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
    link: int,  # LINK that the vehicle takes next
    distance: float,  # from the vehicle's centre to the end of its lane, m
    scratch: Scratch,
) -> float:
    """Return the constraint of vehicles on the junction that turn into the same lane.

    These vehicles are slow in a turn, so a fast vehicle brakes early for them.
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
def hold_inside(
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
    """Return the reason (HOLD_*) for row i to stop at the waiting position of `link`, if any.

    The arguments are the same as for `hold_at_line`. The distance is negative inside the junction.
    """
    wait_m = roads.links[link]["wait_m"]
    if wait_m == math.inf:
        return HOLD_NONE
    signal = link_signal(roads, link, phase)
    gives_way = signal != SIGNAL_GREEN_MAJOR and signal != SIGNAL_OFF
    hold = _hold_for_foes(
        roads, travel, rows, i, link, distance, wait_m, True, gives_way, phase, scratch
    )
    if hold != HOLD_NONE:
        return hold
    if exit_blocked(roads, travel, rows, rows[i], link, way, phase, scratch):
        return HOLD_EXIT_BLOCKED
    return HOLD_NONE


@inlined_kernel
def before_waiting(
    roads: RoadArrays,
    kind: np.void,
    row: np.void,
    link: int,
    place: float,  # distance of the front beyond the stop line, m
    waits: int,  # HOLD_*, reason to stop at the waiting position
    minor: bool,  # whether the driver yields and, as in SUMO, approaches ready to stop
    dt: float,
) -> float:
    """Return the constraint of the waiting position inside the junction."""
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
    i: int,  # row of the vehicle
    link: int,  # LINK that the vehicle drives on
    place: float,  # distance of its centre beyond the end of the previous lane, m
    way: int,  # the vehicle's `way` beyond the junction
    phase: NDArray[np.int32],  # (num_signals,) active PHASE rows
    dt: float,  # length of a tick, s
    scratch: Scratch,  # with the lane and link indices of this tick
) -> tuple[float, int, int]:
    """Return the constraint on row i of foes on the junction; row i's front has passed its line.

    Of two vehicles in conflict, the vehicle nearer to the shared area goes first; at equal
    distance, the vehicle with the smaller id. If both drive into the same lane, the other
    vehicle follows. At a waiting position inside the junction, row i waits until it may go on.

    Returns:
        The constraint; the reason why the vehicle cannot go on (HOLD_*), including a foe that stays
        in its way; the reason to stop at the waiting position (HOLD_*).
    """
    row = rows[i]
    kind = travel.types[row["vtype"]]
    half = 0.5 * row["length"]
    front = place + half
    constraint, waits = no_constraint(kind), HOLD_NONE
    target = roads.links[link]
    if target["wait_m"] < math.inf and front <= target["wait_m"] + WAIT_SLACK_M:
        waits = hold_inside(roads, travel, rows, i, link, -place, way, phase, scratch)
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
            if foe["row"] == i or roads.links[foe["link"]]["from_lane"] == target["from_lane"]:
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
    """Return the constraint of `foe` on a row that is `place` m beyond its stop line."""
    half = 0.5 * row["length"]
    front = place + half
    foe_front = foe["half"] - foe["dist"]
    foe_rear = -foe["half"] - foe["dist"]
    wait_m = roads.links[foe["link"]]["wait_m"]
    other = rows[foe["row"]]
    stops = foe["speed"] < STANDING_MPS
    if not is_steered(row) and not is_steered(other):
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
    # Gap between both vehicles, measured backwards from the end of the shared area.
    gap = (conflict["leave_m"] - front) - (conflict["foe_leave_m"] - foe_rear)
    if to_area >= 0.0:
        if foe_to_area > to_area or (foe_to_area == to_area and foe["id"] > row["id"]):
            return no_constraint(kind)
        if conflict["merging"] and gap > to_area:
            return behind(kind, row["speed"], gap, foe["speed"], kind["decel"])
        return before_line(kind, row["speed"], to_area, dt)
    # Both are in the shared area: the vehicle nearer to the end of the area goes first.
    if foe_to_area > 0.0:
        return no_constraint(kind)
    rest = conflict["leave_m"] - front
    foe_rest = conflict["foe_leave_m"] - foe_front
    if foe_rest > rest or (foe_rest == rest and foe["id"] > row["id"]):
        return no_constraint(kind)
    return behind(kind, row["speed"], gap, foe["speed"], kind["decel"])
