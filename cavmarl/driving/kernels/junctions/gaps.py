"""Which gaps a driver takes at a junction: whether a foe is, or will be, where it would be.

What a driver counts with is what SUMO's counts with: it gives a foe before its line, and itself,
the whole way over the junction, and takes the foe to speed up as it does. Foes on the junction are
asked by the shared area alone. Where one of two is steered, other times hold.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Travel
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_YIELD,
    SIGNAL_GREEN_MINOR,
    SIGNAL_NONE,
    SIGNAL_OFF_BLINKING,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_STOP_THEN_GO,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.core.records.rows import WAIT_SLACK_M
from cavmarl.driving.kernels.junctions.deadlocks import STATE_EQUAL, drives_as_sumo
from cavmarl.driving.kernels.junctions.stop_line_registration import (
    IMPATIENT_S,
    STANDING_MPS,
    can_be_ignored,
)
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M

BRISK_ACCEL = 2.5  # m/s², with which a driver may soon be in a shared area,
GENTLE_ACCEL = 1.8  # and, to be safe, with which it and others are out of it,
GENTLE_SHARE = GENTLE_ACCEL / BRISK_ACCEL  # or such a share of what a slower one has
HARD_STOP = 5.0  # m/s², a vehicle that needs more to stop before the line will not stop
AHEAD_S = 1.0  # s before a foe is at its line (SUMO's 1.0 start from nearer to their own);
STOPPED_FOE_S = 30.0  # by which one that can stop comes later, if the other has waited for long;
STEERED_AHEAD_S = 3.0  # where one of both is steered: it may take longer than it seems,
STEERED_MERGE_AHEAD_S = 1.5  # and where both lead into the same lane, which lets one fall in behind
SPEEDING_UP_MPS2 = 0.1  # from which on a foe counts as one that goes on speeding up
GAP_S = 1.0  # s between the last of one and the first of the other in a shared area
SET_OFF_S = 0.5  # one that stands sets off this long before another is out of it
ROOM_M = 3.0  # free way left behind a vehicle that clears a junction
IMPATIENCE_S = 180.0  # after which a vehicle that gives way counts on others to brake,
FORCED_STOP = 4.5  # m/s², and how hard at most
# Of the way to where one may have to stop, on which it speeds up and need not brake for that yet.
UNBRAKED_SHARE = FORCED_STOP / (FORCED_STOP + BRISK_ACCEL)
CRAWL_MPS = 5.0  # a stream that is slower lets others in
STUCK_S = 90.0  # after which it passes others that stand and give way, too;
RESCUED_S = 300.0  # if both drive as SUMO's do: then that would put one elsewhere
STOP_SIGN_S = 0.5  # how long one stands at a stop sign, and before a tie is broken;
STOOD_S = 0.1  # background vehicles, as SUMO's, only for a moment
ARRIVES_M = 1.0  # a trip that ends no further behind a line leads over no junction
STATE_MAJOR = ord("M")
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
    """Whether vehicles on `link` give way to others."""
    target = roads.links[link]
    if target["num_conflicts"] == 0:
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


@inlined_kernel
def _in_turn(state: int) -> bool:
    """Whether of two that wait at links of such a state the one goes that has stood longer."""
    return state == STATE_EQUAL or state == STATE_ALLWAY_STOP


@kernel
def ignores(
    row: np.void,
    foe: np.void,
    link: int,
    foe_link: int,
    signal: int,
    state: int,
    foe_state: int,
    stuck_s: float,
) -> bool:
    """Whether a driver at `link` need not wait for a foe at `foe_link` that has the right of way.

    `signal` is what the foe's own signal shows, `state` and `foe_state` are those of the links.
    After `stuck_s` it passes one that stands and gives way, too.
    """
    if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
        return True
    if signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR:
        return True  # a vehicle that cannot stop any more was checked before
    if can_be_ignored(foe):
        return True
    if signal == SIGNAL_NONE and foe_state == STATE_ALLWAY_STOP and foe["stopped_at"] != foe_link:
        return True  # it has to stand once, too, and has not yet
    if foe["speed"] > STANDING_MPS or not _gives_way(foe, foe_link):
        return False
    # Where its signal is off and blinks, the foe has to give way, too.
    in_turn = _in_turn(state) or signal == SIGNAL_OFF_BLINKING
    if not (in_turn or row["wait_s"] > stuck_s):
        return False  # the other road comes first even while it waits itself
    # Among equals each may wait for the next all around: those that wait do not stop one another.
    if (state == STATE_EQUAL and row["wait_s"] > IMPATIENT_S) or _goes_on(row, link):
        return True
    # Both wait: the one that has stood longer goes first, and then goes on.
    if row["wait_s"] < STOP_SIGN_S or row["speed"] > STANDING_MPS:
        return False
    longer: bool = row["wait_s"] > foe["wait_s"]
    return longer or (row["wait_s"] == foe["wait_s"] and row["id"] < foe["id"])


@inlined_kernel
def _is_committed(foe: np.void, front: float) -> bool:
    """Whether an APPROACH with its front so many m before a line does not stop there any more."""
    committed: bool = foe["speed"] * foe["speed"] > 2.0 * HARD_STOP * max(front, 0.01)
    return committed


@kernel
def _is_harmless(
    roads: RoadArrays,
    travel: Travel,
    rows: NDArray[np.void],
    row: np.void,
    link: int,
    conflict: np.void,
    foe: np.void,
    front: float,
    apart: float,
    comes_last: bool,
    phase: NDArray[np.int32],
    equal: bool,
) -> bool:
    """Whether an APPROACH need not be minded, whenever it comes to the shared area.

    Its `front` has so many m to where it can still stop; its rear leaves the shared area `apart` m
    before the own one. `comes_last`: it has to give way.
    """
    if front <= 0.0:
        # Another vehicle keeps one that stands before the shared area out of it.
        before_area = foe["dist"] + conflict["foe_enter_m"] - foe["half"] > 0.0
        if before_area and foe["speed"] < STANDING_MPS and rows[foe["row"]]["wait_s"] > IMPATIENT_S:
            return True
        # Behind one that is faster and leads into the same lane, one can follow.
        follows: bool = conflict["merging"] and apart > ROOM_M and row["speed"] <= foe["speed"]
        return follows
    if 0.0 < rows[foe["row"]]["to_go"] < foe["dist"] + ARRIVES_M:
        return True  # its trip ends before its line
    if _is_committed(foe, front):
        return False
    if comes_last:
        return True
    other, foe_link = rows[foe["row"]], conflict["foe"]
    if equal and row["wait_s"] < STUCK_S:
        return can_be_ignored(other)  # one that waits in a circle is left out before
    signal = link_signal(roads, foe_link, phase)
    state, foe_state = roads.links[link]["state"], roads.links[foe_link]["state"]
    alike = drives_as_sumo(travel, row) and drives_as_sumo(travel, other)
    stuck_s = RESCUED_S if alike else STUCK_S
    if ignores(row, other, link, foe_link, signal, state, foe_state, stuck_s):
        return True
    # A vehicle that has been let in goes on, where others can still brake for it.
    brakes: bool = foe["speed"] * foe["speed"] < 2.0 * FORCED_STOP * front
    return brakes and _goes_on(row, link)


@inlined_kernel
def _brisk(travel: Travel, row: np.void) -> float:
    """How hard a vehicle speeds up, in m/s²: long ones less."""
    brisk: float = BRISK_ACCEL
    if row["driver"] != DRIVER_AGENT:
        brisk = min(BRISK_ACCEL, travel.types[row["vtype"]]["accel"])
    return brisk


@inlined_kernel
def stays_inside(foe: np.void) -> bool:
    """Whether a vehicle on a junction stays where it is: it stands, or has to stop for one."""
    stands = (foe["speed"] < STANDING_MPS) & (foe["wait_s"] > IMPATIENT_S)
    stays: bool = stands | (foe["hold"] == HOLD_EXIT_BLOCKED)
    return stays


@inlined_kernel
def _comes_to_steered(
    row: np.void, conflict: np.void, foe: np.void, front: float, leaves_mps: float, time_out: float
) -> bool:
    """Whether, with one of both in an agent's seat, an APPROACH comes before a row is out.

    Its `front` has so many m to where it can still stop.
    """
    # One that has waited for long counts on the foe to brake. A stream that crawls bumper to bumper
    # lets it in.
    patience = min(row["wait_s"] / IMPATIENCE_S, 1.0)
    if conflict["merging"] and STANDING_MPS < foe["speed"] < CRAWL_MPS:
        if foe["speed"] * foe["speed"] < 2.0 * FORCED_STOP * patience * front:
            return False
    arrives = (foe["dist"] - foe["half"]) / max(foe["speed"], STANDING_MPS)
    arrives *= 1.0 + patience
    ahead_s = STEERED_MERGE_AHEAD_S if conflict["merging"] else STEERED_AHEAD_S
    faster_mps = foe["speed"] - leaves_mps
    if conflict["merging"] and row["driver"] == DRIVER_AGENT and faster_mps > 0.0:
        # A steered car comes slowly out of a turn: one that is fast needs the way to brake.
        ahead_s = max(ahead_s, faster_mps * faster_mps / (2.0 * FORCED_STOP * foe["speed"]))
    comes: bool = arrives < time_out + ahead_s
    return comes


@inlined_kernel
def _comes(
    roads: RoadArrays,
    row: np.void,
    conflict: np.void,
    foe: np.void,
    other: np.void,
    time_in: float,
    time_out: float,
    leaves_mps: float,
) -> bool:
    """Whether an APPROACH, of VEHICLE row `other`, is at its line too soon for a row.

    The row is where one waits at its line in `time_in` s, and out of the junction in `time_out` s
    with `leaves_mps`. Into the lane of a foe that it would slow down it goes only if braking is
    enough; one that waits counts on that from when it goes, the harder the longer it has waited.
    """
    to_line = foe["dist"] - foe["half"]
    if other["accel"] > SPEEDING_UP_MPS2:
        top = roads.lanes[roads.links[conflict["foe"]]["from_lane"]]["speed_mps"]
        arrives = _earliest(to_line, foe["speed"], top, other["accel"])
    else:
        arrives = to_line / max(foe["speed"], STANDING_MPS)
    if conflict["merging"]:
        mean_mps = max(to_line / max(arrives, 0.1), STANDING_MPS)
        # One that stands may set off at once.
        patience = min(row["wait_s"] / IMPATIENCE_S, 1.0) if foe["speed"] > STANDING_MPS else 0.0
        brakes, left = FORCED_STOP, to_line
        if patience > 0.0:
            brakes, left = FORCED_STOP * patience, max(to_line - mean_mps * time_in, 0.0)
        slow_mps = math.sqrt(max(mean_mps * mean_mps - 2.0 * brakes * left, 0.0))
        if leaves_mps <= slow_mps:
            return True
        later_s = STOPPED_FOE_S
        if slow_mps > 0.0:
            later_s = 2.0 * left / (mean_mps + slow_mps) - left / mean_mps
        arrives += patience * later_s
    comes: bool = arrives < time_out + AHEAD_S
    return comes


@kernel
def _blocks_inside(
    roads: RoadArrays,
    travel: Travel,
    row: np.void,
    link: int,
    distance: float,
    limit: float,
    conflict: np.void,
    foe: np.void,
    other: np.void,
    to_clear: float,
    equal: bool,
) -> int:
    """`foe_blocks` of one on the junction, VEHICLE row `other`, that has `to_clear` m to go."""
    target, half = roads.links[link], 0.5 * row["length"]
    to_area = distance + conflict["enter_m"] - half
    cleared = to_clear / max(foe["speed"], 0.1)
    brisk = _brisk(travel, row)
    time_in = _earliest(to_area, row["speed"], limit, brisk)
    if stays_inside(other):
        return HOLD_EXIT_BLOCKED
    if equal and conflict["merging"]:
        apart = distance + conflict["leave_m"] - half - to_clear
        return HOLD_YIELD if apart < ROOM_M else HOLD_NONE  # in its lane there is no room yet
    if _in_turn(target["state"]) and _goes_on(row, link) and to_area > ROOM_M:
        return HOLD_NONE  # it lost its turn if it stood once more, and can wait before the area
    top = roads.lanes[roads.links[conflict["foe"]]["next_lane"]]["speed_mps"]
    if foe["speed"] > STANDING_MPS and other["accel"] > -GENTLE_ACCEL:
        # One that has just set off does not stay so slow; one that brakes may have to stop.
        cleared = _earliest(to_clear, foe["speed"], top, GENTLE_SHARE * _brisk(travel, other))
    elif foe["speed"] * foe["speed"] < -2.0 * other["accel"] * to_clear:
        cleared = math.inf  # it brakes so hard that it stops before it is out
    if row["driver"] == DRIVER_AGENT or other["driver"] == DRIVER_AGENT:
        time_in -= 0.5 * GAP_S
    elif row["speed"] <= STANDING_MPS and not equal and not _goes_on(row, link):
        if target["state"] != STATE_ALLWAY_STOP:
            time_in = min(SET_OFF_S, time_in)
        else:  # in turn: it sets off so that it need not brake on its way
            free = (to_area - LINE_MARGIN_M) * UNBRAKED_SHARE
            time_in = _earliest(free, row["speed"], limit, brisk)
            if other["accel"] > SPEEDING_UP_MPS2:
                cleared = _earliest(to_clear, foe["speed"], top, other["accel"])
    return HOLD_YIELD if cleared > time_in else HOLD_NONE


@kernel
def foe_blocks(
    roads: RoadArrays,
    travel: Travel,
    rows: NDArray[np.void],
    row: np.void,
    link: int,
    distance: float,
    limit: float,
    conflict: np.void,
    foe: np.void,
    gives_way: bool,
    phase: NDArray[np.int32],
    equal: bool = False,  # whether both resolve deadlocks of equal roads; see `deadlocks`
) -> int:
    """Whether one APPROACH is, or will be, in the shared area while `row` is, or goes first.

    HOLD_EXIT_BLOCKED says that it stays there; HOLD_YIELD that it will come, or leave.
    """
    to_clear = foe["dist"] + conflict["foe_leave_m"] + foe["half"]
    if to_clear <= 0.0 or (foe["dist"] < foe["half"] and not conflict["near"]):
        return HOLD_NONE
    target = roads.links[link]
    foe_link = roads.links[conflict["foe"]]
    # Its front before the line that it can still stop at: the stop line, or, where it passes that
    # and the shared area lies further on, its waiting position inside.
    front = foe["dist"] - foe["half"] - roads.lanes[foe_link["from_lane"]]["stop_back_m"]
    comes_last = not (gives_way and conflict["must_yield"])
    if comes_last and front > 0.0 and not _is_committed(foe, front):
        return HOLD_NONE  # the answer for most, without a look at its VEHICLE row
    wait_m = foe_link["wait_m"]
    other = rows[foe["row"]]
    steered = row["driver"] == DRIVER_AGENT or other["driver"] == DRIVER_AGENT
    passes = front <= 0.0 or (not steered and _is_committed(foe, front))
    if passes and conflict["foe_enter_m"] >= wait_m - LINE_MARGIN_M:
        front += wait_m + WAIT_SLACK_M
    half = 0.5 * row["length"]
    apart = distance + conflict["leave_m"] - half - to_clear
    if _is_harmless(
        roads, travel, rows, row, link, conflict, foe, front, apart, comes_last, phase, equal
    ):
        return HOLD_NONE
    if front <= 0.0:
        return _blocks_inside(
            roads, travel, row, link, distance, limit, conflict, foe, other, to_clear, equal
        )
    # A foe before its line, and the vehicle itself, are given the whole way over the junction.
    over, brisk = target["length_m"], _brisk(travel, row)
    if conflict["enter_m"] < target["wait_m"] - LINE_MARGIN_M:
        over = min(over, target["wait_m"])
    passed = (foe["dist"] + foe_link["length_m"] + foe["half"]) / max(foe["speed"], 0.1)
    after_s = GAP_S if conflict["merging"] else 0.0
    if passed + after_s < _earliest(distance - half, row["speed"], limit, brisk):
        return HOLD_NONE
    speed, to_line = row["speed"], distance - half
    if not (steered or conflict["merging"]) and speed <= STANDING_MPS:
        # One that waits is as good as at its line, or its place inside: SUMO's stand there.
        inside = to_line < 0.0 and target["wait_m"] < math.inf
        ahead = to_line + target["wait_m"] if inside else to_line
        to_line -= min(max(ahead, 0.0), LINE_MARGIN_M)
    over += min(to_line, 0.0)  # from a waiting position: the rest
    reached = math.sqrt(speed * speed + 2.0 * brisk * max(over, 0.0))
    leaves_mps = min(reached, max(limit, speed))
    time_line = _earliest(to_line, speed, limit, GENTLE_SHARE * brisk)
    time_out = time_line + 2.0 * (over + row["length"]) / max(speed + leaves_mps, STANDING_MPS)
    if steered:
        comes = _comes_to_steered(row, conflict, foe, front, leaves_mps, time_out)
    else:
        time_in = _earliest(distance - half - LINE_MARGIN_M, speed, limit, GENTLE_SHARE * brisk)
        comes = _comes(roads, row, conflict, foe, other, time_in, time_out, leaves_mps)
    return HOLD_YIELD if comes else HOLD_NONE
