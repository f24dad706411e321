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

from cavmarl.core.numba import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, Travel
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
    MODEL_KRAUSS,
    SIGNAL_GREEN_MAJOR,
    SIGNAL_GREEN_MINOR,
    SIGNAL_NONE,
    SIGNAL_OFF,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_STOP_THEN_GO,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.driving.kernels.announcing import IMPATIENT_S, STANDING_MPS, is_let_stand
from cavmarl.driving.kernels.following import LINE_MARGIN_M, before_line, behind, no_press
from cavmarl.driving.kernels.ways import next_step

FOE_ACCEL = 2.5  # m/s², how a driver thinks that others speed up over a junction,
OWN_ACCEL = 1.8  # and, to be safe, itself
# m/s², a driver stops for yellow where this braking is enough; Krauss's brakes as hard as it can
COMFORT_STOP = 3.0
HARD_STOP = 5.0  # m/s², a vehicle that needs more to stop before the line will not stop
GAP_S = 1.0  # s between the last of one and the first of the other in a shared area
STEERED_MPS = 5.0  # a steered car is taken to turn no faster than this
LAST_CHANCE_M = 3.0  # with the front this near to the line
ROOM_M = 3.0  # free way left behind a vehicle that clears a junction
EXIT_LANES = 4  # looked along for room,
EXIT_LOOK_M = 75.0  # and no further than this: ten cars stand there
IMPATIENCE_S = 180.0  # after which a vehicle that gives way counts on others to brake,
FORCED_STOP = 4.5  # m/s², and how hard for one that is on its way
STUCK_S = 60.0  # after which it passes others that stand and give way, too
STOP_LINE_M = 5.0  # standing with the front nearer than this counts as standing at the line
STOP_SIGN_S = 0.5  # how long one stands at a stop sign, and before a tie is broken;
STOOD_S = 0.1  # background vehicles, as SUMO's, only for a moment
WAIT_SLACK_M = 0.5  # a front this far beyond a waiting position still waits there
STATE_MAJOR = ord("M")
STATE_EQUAL = ord("=")
STATE_STOP = ord("s")
STATE_ALLWAY_STOP = ord("w")


@kernel
def link_signal(roads: RoadArrays, link: int, phase: NDArray[np.int32]) -> int:
    """The letter that a link's signal shows, as a SIGNAL_* code; `phase` (num_signals,)."""
    signal = roads.links[link]["signal"]
    if signal < 0:
        return SIGNAL_NONE
    first = roads.phases[phase[signal]]["first_state"]
    return int(roads.phase_states[first + roads.links[link]["signal_index"]])


@kernel
def _earliest(distance: float, speed: float, limit: float, accel: float) -> float:
    """Time in s to drive `distance` m when speeding up with `accel` m/s² to `limit` m/s."""
    if distance <= 0.0:
        return 0.0
    limit = max(limit, speed, 0.1)
    ramp = (limit * limit - speed * speed) / (2.0 * accel)
    if distance < ramp:
        return (math.sqrt(speed * speed + 2.0 * accel * distance) - speed) / accel
    return (limit - speed) / accel + (distance - ramp) / limit


@inlined_kernel
def must_stop(roads: RoadArrays, link: int, signal: int) -> bool:
    """Whether each vehicle has to stand once before `link`, whose signal shows `signal`."""
    state = roads.links[link]["state"]
    signed = signal == SIGNAL_NONE and (state == STATE_STOP or state == STATE_ALLWAY_STOP)
    return signed or signal == SIGNAL_STOP_THEN_GO


@inlined_kernel
def is_minor(roads: RoadArrays, link: int, phase: NDArray[np.int32]) -> bool:
    """Whether vehicles on `link` give way to others already before the junction."""
    target = roads.links[link]
    if target["num_conflicts"] == 0 or target["wait_m"] < math.inf:
        return False
    signal = link_signal(roads, link, phase)
    gives_way: bool = signal == SIGNAL_GREEN_MINOR
    if signal == SIGNAL_NONE:
        gives_way = target["state"] != STATE_MAJOR
    return gives_way


@inlined_kernel
def _goes_on(row: np.void, link: int) -> bool:
    """Whether a vehicle that has stood before `link` was let in. An agent's says so by moving."""
    goes: bool = row["driver"] != DRIVER_AGENT or row["wait_s"] == 0.0
    return goes and row["hold"] == HOLD_NONE and row["stopped_at"] == link


@inlined_kernel
def _gives_way(row: np.void, link: int) -> bool:
    """Whether a standing vehicle waits before `link` for others: an agent's at its stop line."""
    stands: bool = row["driver"] == DRIVER_AGENT and row["wait_s"] > 0.0
    return row["hold"] == HOLD_YIELD or (stands and row["stopped_at"] == link)


@kernel
def _ignores(
    row: np.void,
    foe: np.void,
    link: int,
    foe_link: int,
    signal: int,
    stops_first: bool,
    in_turn: bool,
    equal: bool,
) -> bool:
    """Whether a driver at `link` need not wait for a foe at `foe_link` that has the right of way.

    `signal` is what the foe's own signal shows; `stops_first`: it has to stand once in any case;
    `in_turn`: of two that wait the one goes that has stood longer, whatever road it is on.
    """
    if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
        return True
    if signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR:
        return True  # a vehicle that cannot stop any more was checked before
    if is_let_stand(foe):
        return True
    if stops_first and foe["stopped_at"] != foe_link:
        return True  # it stands once, too, and has not yet
    if foe["speed"] > STANDING_MPS or not (_gives_way(foe, foe_link) and in_turn):
        return False
    # Both wait: the one that has stood longer goes first, and then goes on.
    if equal or _goes_on(row, link):
        return True
    if row["wait_s"] < STOP_SIGN_S or row["speed"] > STANDING_MPS:
        return False
    longer: bool = row["wait_s"] > foe["wait_s"]
    return longer or (row["wait_s"] == foe["wait_s"] and row["id"] < foe["id"])


@kernel
def _is_harmless(
    roads: RoadArrays,
    rows: NDArray[np.void],
    row: np.void,
    link: int,
    conflict: np.void,
    foe: np.void,
    front: float,
    apart: float,
    gives_way: bool,
    phase: NDArray[np.int32],
) -> bool:
    """Whether an APPROACH need not be minded, whenever it comes to the shared area.

    Its `front` has so many m to where it can still stop; its rear leaves the shared area `apart` m
    before the own one.
    """
    if front <= 0.0:
        # Another vehicle keeps one that stands before the shared area out of it.
        before_area = foe["dist"] + conflict["foe_enter_m"] - foe["half"] > 0.0
        if before_area and foe["speed"] < STANDING_MPS and rows[foe["row"]]["wait_s"] > IMPATIENT_S:
            return True
        # Behind one that is faster and leads into the same lane, one can follow.
        follows: bool = conflict["merging"] and apart > ROOM_M and row["speed"] <= foe["speed"]
        return follows
    committed = foe["speed"] * foe["speed"] > 2.0 * HARD_STOP * max(front, 0.01)
    if committed:
        return False
    if not (gives_way and conflict["must_yield"]):
        return True
    signal = link_signal(roads, conflict["foe"], phase)
    stops_first = signal == SIGNAL_NONE and roads.links[conflict["foe"]]["state"] == STATE_ALLWAY_STOP
    state = roads.links[link]["state"]
    in_turn = state == STATE_EQUAL or state == STATE_ALLWAY_STOP or row["wait_s"] > STUCK_S
    if _ignores(row, rows[foe["row"]], link, conflict["foe"], signal, stops_first, in_turn, state == STATE_EQUAL):
        return True
    # A vehicle that has been let in goes on, where others can still brake for it.
    brakes: bool = foe["speed"] * foe["speed"] < 2.0 * FORCED_STOP * front
    return brakes and _goes_on(row, link)


@kernel
def _foe_blocks(
    roads: RoadArrays,
    rows: NDArray[np.void],
    row: np.void,
    link: int,
    distance: float,
    limit: float,
    conflict: np.void,
    foe: np.void,
    gives_way: bool,
    phase: NDArray[np.int32],
) -> bool:
    """Whether one APPROACH is, or will be, in the shared area while `row` is, or goes first."""
    to_clear = foe["dist"] + conflict["foe_leave_m"] + foe["half"]
    if to_clear <= 0.0:
        return False
    target = roads.links[link]
    foe_link = roads.links[conflict["foe"]]
    # Its front before the line that it can still stop at: the stop line, or, where the shared
    # area lies beyond that, its waiting position inside.
    front = foe["dist"] - foe["half"] - roads.lanes[foe_link["from_lane"]]["stop_back_m"]
    wait_m = foe_link["wait_m"]
    if front <= 0.0 and conflict["foe_enter_m"] >= wait_m - LINE_MARGIN_M:
        front += wait_m + WAIT_SLACK_M
    half = 0.5 * row["length"]
    apart = distance + conflict["leave_m"] - half - to_clear
    if _is_harmless(roads, rows, row, link, conflict, foe, front, apart, gives_way, phase):
        return False
    cleared = to_clear / max(foe["speed"], 0.1)
    time_in = _earliest(distance + conflict["enter_m"] - half, row["speed"], limit, FOE_ACCEL)
    if front <= 0.0:
        state = target["state"]
        in_turn = state == STATE_EQUAL or state == STATE_ALLWAY_STOP
        if in_turn and _goes_on(row, link) and distance + conflict["enter_m"] - half > ROOM_M:
            return False  # it lost its turn if it stood once more, and can wait before the area
        if foe["speed"] > STANDING_MPS:  # one that has just set off does not stay so slow
            top = roads.lanes[roads.links[conflict["foe"]]["next_lane"]]["speed_mps"]
            cleared = _earliest(to_clear, foe["speed"], top, OWN_ACCEL)
        inside: bool = cleared + 0.5 * GAP_S > time_in
        return inside
    # A foe before its line, and the vehicle itself, are given the whole way over the junction.
    over = target["wait_m"] if conflict["enter_m"] < target["wait_m"] else target["length_m"]
    passed = (foe["dist"] + foe_link["length_m"] + foe["half"]) / max(foe["speed"], 0.1)
    after_s = GAP_S if conflict["merging"] else 0.0
    if passed + after_s < _earliest(distance - half, row["speed"], limit, FOE_ACCEL):
        return False
    time_out = _earliest(distance + over + half, row["speed"], limit, OWN_ACCEL)
    # With the speed that it has; it is counted on to brake by those who have waited for long.
    arrives = (foe["dist"] - foe["half"]) / max(foe["speed"], STANDING_MPS)
    arrives *= 1.0 + min(row["wait_s"] / IMPATIENCE_S, 1.0)
    return arrives < time_out + GAP_S


@kernel
def _blocked_by_foes(
    roads: RoadArrays,
    rows: NDArray[np.void],
    i: int,
    link: int,
    distance: float,
    wait_m: float,
    inside: bool,
    gives_way: bool,
    phase: NDArray[np.int32],
    scratch: Scratch,
) -> bool:
    """Whether a foe is, or will be, where row i would be on `link`, `distance` m from its line.

    Asks about the shared areas before `wait_m`, or, from `inside`, about those beyond.
    """
    row = rows[i]
    limit = roads.lanes[roads.links[link]["next_lane"]]["speed_mps"]
    if row["driver"] == DRIVER_AGENT:
        limit = min(limit, STEERED_MPS)
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        begin = scratch.link_start[conflict["foe"]]
        end = scratch.link_end[conflict["foe"]]
        if begin == end or (conflict["enter_m"] >= wait_m - LINE_MARGIN_M) != inside:
            continue
        for k in range(begin, end):
            foe = scratch.approach[k]
            if foe["row"] != i and _foe_blocks(
                roads, rows, row, link, distance, limit, conflict, foe, gives_way, phase
            ):
                return True
    return False


@kernel
def _exit_blocked(
    roads: RoadArrays, travel: Travel, row: np.void, link: int, way: int, scratch: Scratch
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
    travel: Travel,
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
    stops = kind["decel"] if kind["model"] == MODEL_KRAUSS else COMFORT_STOP
    if (signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR) and needed < stops:
        # A vehicle that gave way at the line all through green goes now, as the others stop.
        if row["hold"] != HOLD_YIELD or front > LAST_CHANCE_M:
            return HOLD_SIGNAL
    target = roads.links[link]
    if target["num_conflicts"] == 0:
        return HOLD_NONE
    if must_stop(roads, link, signal) and row["stopped_at"] != link:
        return HOLD_YIELD
    gives_way = signal != SIGNAL_GREEN_MAJOR and signal != SIGNAL_OFF
    if _blocked_by_foes(
        roads, rows, i, link, distance, target["wait_m"], False, gives_way, phase, scratch
    ):
        return HOLD_YIELD
    if _exit_blocked(roads, travel, row, link, way, scratch):
        return HOLD_EXIT_BLOCKED
    return HOLD_NONE


@inlined_kernel
def note_stop(
    roads: RoadArrays,
    row: np.void,  # VEHICLE of an agent before its tick; stopped_at is written
    link: int,  # that its plan takes at the end of its lane, or -1
    phase: NDArray[np.int32],  # (num_signals,) PHASE rows that are on
) -> None:
    """Note before which stop sign an agent's vehicle has stood, until it leaves that lane."""
    if row["stopped_at"] >= 0 and roads.links[row["stopped_at"]]["from_lane"] != row["lane"]:
        row["stopped_at"] = -1
    if link < 0 or row["wait_s"] < STOP_SIGN_S or roads.lanes[row["lane"]]["internal"]:
        return
    here = roads.lanes[row["lane"]]
    to_line = here["length_m"] - row["s"] - 0.5 * row["length"] - here["stop_back_m"]
    if to_line < STOP_LINE_M and must_stop(roads, link, link_signal(roads, link, phase)):
        row["stopped_at"] = link


@kernel
def waits_inside(
    roads: RoadArrays,
    travel: Travel,
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
    if _blocked_by_foes(roads, rows, i, link, distance, wait_m, True, gives_way, phase, scratch):
        return HOLD_YIELD
    if _exit_blocked(roads, travel, rows[i], link, way, scratch):
        return HOLD_EXIT_BLOCKED
    return HOLD_NONE


@kernel
def press_inside(
    roads: RoadArrays,
    travel: Travel,
    rows: NDArray[np.void],  # VEHICLE (C,)
    i: int,  # the row that asks
    link: int,  # that it drives on
    place: float,  # of its centre, m beyond the end of the lane that it comes from
    way: int,  # of the row beyond the junction
    phase: NDArray[np.int32],  # (num_signals,) PHASE rows that are on
    dt: float,  # seconds a tick
    scratch: Scratch,  # with the lane and link indices of this tick
) -> tuple[float, int]:  # press, and why it holds at the waiting position (HOLD_*)
    """How foes on the same junction press row i, whose front is beyond its stop line.

    Of two vehicles in conflict the one that is nearer to the shared area goes first; at equal
    distance the smaller id. Where both lead into one lane, the other follows it there. At a
    waiting position inside, row i waits until it may go on.
    """
    row = rows[i]
    kind = travel.types[row["vtype"]]
    half = 0.5 * row["length"]
    front = place + half
    press = no_press(kind)
    target = roads.links[link]
    wait_m = target["wait_m"]
    if front <= wait_m + WAIT_SLACK_M:
        hold = waits_inside(roads, travel, rows, i, link, -place, way, phase, scratch)
        if hold != HOLD_NONE:
            return before_line(kind, row["speed"], wait_m - front, dt), hold
    first = target["first_conflict"]
    for c in range(first, first + target["num_conflicts"]):
        conflict = roads.conflicts[c]
        if place - half > conflict["leave_m"]:
            continue
        for k in range(scratch.link_start[conflict["foe"]], scratch.link_end[conflict["foe"]]):
            foe = scratch.approach[k]
            if foe["row"] != i:
                press = max(press, _press_of(roads, kind, row, conflict, foe, place, dt))
    return press, HOLD_NONE


@kernel
def _press_of(
    roads: RoadArrays,
    kind: np.void,
    row: np.void,
    conflict: np.void,
    foe: np.void,
    place: float,
    dt: float,
) -> float:
    """How one APPROACH presses a row on the same junction, `place` m beyond its stop line."""
    half = 0.5 * row["length"]
    front = place + half
    foe_front = foe["half"] - foe["dist"]
    foe_rear = -foe["half"] - foe["dist"]
    wait_m = roads.links[foe["link"]]["wait_m"]
    waits = (
        foe_front <= wait_m + WAIT_SLACK_M
        and conflict["foe_enter_m"] >= wait_m - LINE_MARGIN_M
        and foe["speed"] < STANDING_MPS
    )
    if foe_front <= 0.0 or foe_rear > conflict["foe_leave_m"] or waits:
        return no_press(kind)
    to_area = conflict["enter_m"] - front
    foe_to_area = conflict["foe_enter_m"] - foe_front
    # How much further the one has to go to be out of the shared area than the other's rear.
    gap = (conflict["leave_m"] - front) - (conflict["foe_leave_m"] - foe_rear)
    if to_area >= 0.0:
        if foe_to_area > to_area or (foe_to_area == to_area and foe["id"] > row["id"]):
            return no_press(kind)
        if conflict["merging"] and gap > to_area:
            return behind(kind, row["speed"], gap, foe["speed"], kind["decel"])
        return before_line(kind, row["speed"], to_area, dt)
    # Both are in it side by side: the one nearer to its end goes on, the other stays behind.
    if foe_to_area > 0.0:
        return no_press(kind)
    rest = conflict["leave_m"] - front
    foe_rest = conflict["foe_leave_m"] - foe_front
    if foe_rest > rest or (foe_rest == rest and foe["id"] > row["id"]):
        return no_press(kind)
    return behind(kind, row["speed"], gap, foe["speed"], kind["decel"])
