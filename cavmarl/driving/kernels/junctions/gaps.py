"""Gap acceptance at junctions: whether two vehicles would occupy the shared area together.

The gap model matches SUMO's. If the foe is before its line, both vehicles are assumed to need the
whole junction, and the foe is assumed to keep its acceleration. If the foe is on the junction, only
the shared area counts. If one of the two vehicles is steered, other time gaps apply.

`row` is the VEHICLE of the deciding driver, the ego vehicle. `foe` is a foe's APPROACH, the record
of a vehicle on or before a link (`approach.py`), and `other` is the VEHICLE of the same foe.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, TripTables
from cavmarl.core.records.codes import (
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
from cavmarl.core.records.rows import WAIT_SLACK_M, is_steered
from cavmarl.driving.kernels.junctions.deadlocks import STATE_EQUAL, drives_as_sumo
from cavmarl.driving.kernels.junctions.stop_line_registration import (
    IMPATIENT_S,
    STANDING_MPS,
    can_be_ignored,
)
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M
from cavmarl.roads.kernels.signal_overrides import NOT_OVERRIDDEN, overridden_state

BRISK_ACCEL = 2.5  # m/s²: assumed acceleration towards a shared area
GENTLE_ACCEL = 1.8  # m/s²: assumed acceleration out of a shared area, lower to be safe
GENTLE_SHARE = GENTLE_ACCEL / BRISK_ACCEL  # `GENTLE_ACCEL` as a share of acceleration
HARD_STOP = 5.0  # m/s²: a vehicle that would have to brake harder for the line will not stop
# The foe must reach its line at least this long after the ego vehicle has left the junction. SUMO's
# gap of 1.0 s starts closer to the ego line.
AHEAD_S = 1.0
STOPPED_FOE_S = 30.0  # assumed delay of a foe that can stop, reached after `IMPATIENCE_S`
STEERED_AHEAD_S = 3.0  # time gap if one vehicle is steered, because it may be slower
STEERED_MERGE_AHEAD_S = 1.5  # the same if both enter one lane, where one can follow
SPEEDING_UP_MPS2 = 0.1  # a foe with at least this acceleration is assumed to keep accelerating
GAP_S = 1.0  # time between the exit of one vehicle from a shared area and the entry of another
SET_OFF_S = 0.5  # a stopped vehicle starts this long before another vehicle leaves the area
ROOM_M = 3.0  # free space behind a vehicle that clears a junction
IMPATIENCE_S = 180.0  # after this wait, a driver that yields fully expects foes to brake
FORCED_STOP = 4.5  # m/s²: the deceleration that such a driver expects
# A vehicle that may have to stop can accelerate over this share of the distance, then must brake.
UNBRAKED_SHARE = FORCED_STOP / (FORCED_STOP + BRISK_ACCEL)
CRAWL_MPS = 5.0  # a slower stream lets others merge
STUCK_S = 90.0  # after this wait, a driver may also pass stopped vehicles that must yield to it
RESCUED_S = 300.0  # replaces `STUCK_S` if both have models of SUMO; SUMO then teleports vehicles
STOP_SIGN_S = 0.5  # time to wait at a stop sign, and before a tie is broken
STOOD_S = 0.1  # `STOP_SIGN_S` of background vehicles, as in SUMO
ARRIVES_M = 1.0  # a trip that ends at most this far behind a line does not cross the junction
STATE_MAJOR = ord("M")
STATE_STOP = ord("s")
STATE_ALLWAY_STOP = ord("w")
STATE_ZIPPER = ord("Z")


@kernel
def link_signal(roads: RoadArrays, link: int, phase: NDArray[np.int32]) -> int:
    """Return the state of a link's signal (SIGNAL_*); `phase`: the active PHASE rows."""
    signal = roads.links[link]["signal"]
    if signal < 0:
        return SIGNAL_NONE
    shown = overridden_state(roads, link, phase)
    if shown != NOT_OVERRIDDEN:
        return shown
    first = roads.phases[phase[signal]]["first_state"]
    return int(roads.phase_states[first + roads.links[link]["signal_index"]])


@kernel
def is_red(roads: RoadArrays, link: int, phase: NDArray[np.int32]) -> bool:
    """Return whether a link's signal shows red, alone or with yellow."""
    signal = link_signal(roads, link, phase)
    return signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW


@kernel
def earliest(distance: float, speed: float, limit: float, accel: float) -> float:
    """Return the time in s to drive `distance` m.

    The vehicle accelerates with `accel` m/s² from `speed` up to at most `limit` m/s.
    """
    if distance <= 0.0:
        return 0.0
    limit = max(limit, speed, 0.1)
    ramp = (limit * limit - speed * speed) / (2.0 * accel)
    if distance < ramp:
        return (math.sqrt(speed * speed + 2.0 * accel * distance) - speed) / accel
    return (limit - speed) / accel + (distance - ramp) / limit


@inlined_kernel
def must_stop(roads: RoadArrays, link: int, signal: int) -> bool:
    """Return whether all vehicles must stop once before `link`, whose signal shows `signal`."""
    state = roads.links[link]["state"]
    signed = signal == SIGNAL_NONE and (state == STATE_STOP or state == STATE_ALLWAY_STOP)
    return signed or signal == SIGNAL_STOP_THEN_GO


@inlined_kernel
def is_minor(roads: RoadArrays, link: int, phase: NDArray[np.int32]) -> bool:
    """Return whether vehicles on `link` yield to others."""
    target = roads.links[link]
    if target["num_conflicts"] == 0:
        return False
    signal = link_signal(roads, link, phase)
    gives_way: bool = signal == SIGNAL_GREEN_MINOR
    if signal == SIGNAL_NONE:
        gives_way = target["state"] != STATE_MAJOR and target["state"] != STATE_ZIPPER
    return gives_way


@inlined_kernel
def _has_turn(row: np.void, link: int) -> bool:
    """Return whether a vehicle that stopped at `link` has been given its turn.

    For an agent, moving counts as taking the turn.
    """
    goes: bool = not is_steered(row) or row["wait_s"] == 0.0
    return goes and row["hold"] == HOLD_NONE and row["stopped_at"] == link


@inlined_kernel
def _is_yielding(row: np.void, link: int) -> bool:
    """Return whether a vehicle yields at `link`; an agent that has stopped there counts, too."""
    stands: bool = is_steered(row) and row["wait_s"] > 0.0
    return row["hold"] == HOLD_YIELD or (stands and row["stopped_at"] == link)


@inlined_kernel
def _in_turn(state: int) -> bool:
    """Return whether vehicles at links of this state go in the order in which they stopped."""
    return state == STATE_EQUAL or state == STATE_ALLWAY_STOP


@kernel
def may_ignore(
    row: np.void,
    foe: np.void,
    link: int,
    foe_link: int,
    signal: int,
    state: int,
    foe_state: int,
    stuck_s: float,
) -> bool:
    """Return whether a driver at `link` may ignore a foe at `foe_link` with the right of way.

    `signal` is the state of the foe's signal; `state` and `foe_state` are the links' states. Where
    vehicles go in turn, the driver may also ignore a stopped foe that yields, if it is the driver's
    turn; elsewhere only after a wait of `stuck_s` s.
    """
    if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
        return True
    if signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR:
        return True  # `_is_harmless` has excluded foes that cannot stop
    if can_be_ignored(foe):
        return True
    if signal == SIGNAL_NONE and foe_state == STATE_ALLWAY_STOP and foe["stopped_at"] != foe_link:
        return True  # the foe also has to stop once, and has not yet stopped
    if foe["speed"] > STANDING_MPS or not _is_yielding(foe, foe_link):
        return False
    # If the foe's signal is off and blinks, the foe has to yield as well.
    in_turn = _in_turn(state) or signal == SIGNAL_OFF_BLINKING
    if not (in_turn or row["wait_s"] > stuck_s):
        return False  # the other road has the right of way even while its vehicle waits
    # On equal roads all vehicles could wait for one another, so waiting vehicles are ignored.
    if (state == STATE_EQUAL and row["wait_s"] > IMPATIENT_S) or _has_turn(row, link):
        return True
    # Both wait: the vehicle that has waited longer goes first.
    if row["wait_s"] < STOP_SIGN_S or row["speed"] > STANDING_MPS:
        return False
    longer: bool = row["wait_s"] > foe["wait_s"]
    return longer or (row["wait_s"] == foe["wait_s"] and row["id"] < foe["id"])


@inlined_kernel
def _is_committed(foe: np.void, front: float) -> bool:
    """Return whether an APPROACH whose front is `front` m before a line can no longer stop."""
    committed: bool = foe["speed"] * foe["speed"] > 2.0 * HARD_STOP * max(front, 0.01)
    return committed


@kernel
def _is_harmless(
    roads: RoadArrays,
    travel: TripTables,
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
    """Return whether an APPROACH can be ignored, no matter when it reaches the shared area.

    `front` is the distance in m from the front of the foe to the place where it can still stop.
    `apart` is the distance in m from the ego front to the end of the shared area, minus the
    distance from the foe's rear to that end. `comes_last` says that the foe has to yield.
    """
    if front <= 0.0:
        # A foe that has been stopped for long before the shared area is blocked by another vehicle.
        before_area = foe["dist"] + conflict["foe_enter_m"] - foe["half"] > 0.0
        if before_area and foe["speed"] < STANDING_MPS and rows[foe["row"]]["wait_s"] > IMPATIENT_S:
            return True
        # The ego vehicle can follow a faster foe that drives into the same lane.
        follows: bool = conflict["merging"] and apart > ROOM_M and row["speed"] <= foe["speed"]
        return follows
    if 0.0 < rows[foe["row"]]["to_go"] < foe["dist"] + ARRIVES_M:
        return True  # the foe's trip ends before its line
    if _is_committed(foe, front):
        return False
    if comes_last:
        return True
    other, foe_link = rows[foe["row"]], conflict["foe"]
    if equal and row["wait_s"] < STUCK_S:
        return can_be_ignored(other)  # `junctions` skips foes that let `row` go in a deadlock
    signal = link_signal(roads, foe_link, phase)
    state, foe_state = roads.links[link]["state"], roads.links[foe_link]["state"]
    alike = drives_as_sumo(travel, row) and drives_as_sumo(travel, other)
    stuck_s = RESCUED_S if alike else STUCK_S
    if may_ignore(row, other, link, foe_link, signal, state, foe_state, stuck_s):
        return True
    # A vehicle that has taken its turn continues if the foe can still brake for it.
    brakes: bool = foe["speed"] * foe["speed"] < 2.0 * FORCED_STOP * front
    return brakes and _has_turn(row, link)


@inlined_kernel
def assumed_accel_of(travel: TripTables, row: np.void) -> float:
    """Return the assumed acceleration of a vehicle in m/s², at most that of its type."""
    assumed_accel: float = BRISK_ACCEL
    if not is_steered(row):
        assumed_accel = min(BRISK_ACCEL, travel.types[row["vtype"]]["accel"])
    return assumed_accel


@inlined_kernel
def stays_inside(foe: np.void) -> bool:
    """Return whether a vehicle on a junction stays there because it is stopped or blocked."""
    stands = (foe["speed"] < STANDING_MPS) & (foe["wait_s"] > IMPATIENT_S)
    stays: bool = stands | (foe["hold"] == HOLD_EXIT_BLOCKED)
    return stays


@inlined_kernel
def _comes_to_steered(
    row: np.void, conflict: np.void, foe: np.void, front: float, leaves_mps: float, time_out: float
) -> bool:
    """Return the result of `_comes` if at least one of the two vehicles is steered.

    `front` is the distance in m from the front of the foe to the place where it can still stop.
    """
    # The longer a driver has waited, the harder it expects the foe to brake. A slow stream lets it
    # merge.
    patience = min(row["wait_s"] / IMPATIENCE_S, 1.0)
    if conflict["merging"] and STANDING_MPS < foe["speed"] < CRAWL_MPS:
        if foe["speed"] * foe["speed"] < 2.0 * FORCED_STOP * patience * front:
            return False
    arrives = (foe["dist"] - foe["half"]) / max(foe["speed"], STANDING_MPS)
    arrives *= 1.0 + patience
    ahead_s = STEERED_MERGE_AHEAD_S if conflict["merging"] else STEERED_AHEAD_S
    faster_mps = foe["speed"] - leaves_mps
    if conflict["merging"] and is_steered(row) and faster_mps > 0.0:
        # A steered car leaves a turn slowly, so a fast foe needs room to brake.
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
    """Return whether a foe reaches its line too soon for the vehicle `row`.

    The row is at its line in `time_in` s, and leaves the junction in `time_out` s with `leaves_mps`
    m/s. If both drive into the same lane, the foe has to be able to slow down to that speed. The
    longer the row has waited, the harder the foe is expected to brake once the row starts.
    """
    to_line = foe["dist"] - foe["half"]
    if other["accel"] > SPEEDING_UP_MPS2:
        top = roads.lanes[roads.links[conflict["foe"]]["from_lane"]]["speed_mps"]
        arrives = earliest(to_line, foe["speed"], top, other["accel"])
    else:
        arrives = to_line / max(foe["speed"], STANDING_MPS)
    if conflict["merging"]:
        mean_mps = max(to_line / max(arrives, 0.1), STANDING_MPS)
        # A stopped foe may start at once, so the driver's patience does not count.
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
    travel: TripTables,
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
    """Return `hold_for_foe` for a foe on the junction that clears the area in `to_clear` m."""
    target, half = roads.links[link], 0.5 * row["length"]
    to_area = distance + conflict["enter_m"] - half
    cleared = to_clear / max(foe["speed"], 0.1)
    assumed_accel = assumed_accel_of(travel, row)
    time_in = earliest(to_area, row["speed"], limit, assumed_accel)
    if stays_inside(other):
        return HOLD_EXIT_BLOCKED
    if equal and conflict["merging"]:
        apart = distance + conflict["leave_m"] - half - to_clear
        return HOLD_YIELD if apart < ROOM_M else HOLD_NONE  # wait for room behind the foe
    if _in_turn(target["state"]) and _has_turn(row, link) and to_area > ROOM_M:
        return HOLD_NONE  # go on, so as to keep the turn; the row can still wait before the area
    top = roads.lanes[roads.links[conflict["foe"]]["next_lane"]]["speed_mps"]
    if foe["speed"] > STANDING_MPS and other["accel"] > -GENTLE_ACCEL:
        # A foe that has just started will accelerate; a foe that brakes may have to stop.
        cleared = earliest(
            to_clear, foe["speed"], top, GENTLE_SHARE * assumed_accel_of(travel, other)
        )
    elif foe["speed"] * foe["speed"] < -2.0 * other["accel"] * to_clear:
        cleared = math.inf  # the foe brakes so hard that it stops before it clears the area
    if is_steered(row) or is_steered(other):
        time_in -= 0.5 * GAP_S
    elif row["speed"] <= STANDING_MPS and not equal and not _has_turn(row, link):
        if target["state"] != STATE_ALLWAY_STOP:
            time_in = min(SET_OFF_S, time_in)
        else:  # at an all-way stop, the row starts late enough not to brake before the area
            free = (to_area - LINE_MARGIN_M) * UNBRAKED_SHARE
            time_in = earliest(free, row["speed"], limit, assumed_accel)
            if other["accel"] > SPEEDING_UP_MPS2:
                cleared = earliest(to_clear, foe["speed"], top, other["accel"])
    return HOLD_YIELD if cleared > time_in else HOLD_NONE


@kernel
def hold_for_foe(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    row: np.void,
    link: int,
    distance: float,
    limit: float,
    conflict: np.void,
    foe: np.void,
    gives_way: bool,
    phase: NDArray[np.int32],
    equal: bool = False,  # whether both drivers resolve deadlocks on equal roads, see `deadlocks`
) -> int:
    """Return the HOLD_* code with which a foe holds back the vehicle `row`.

    HOLD_NONE: `row` need not wait for the foe. HOLD_EXIT_BLOCKED: the foe stays in the shared area.
    HOLD_YIELD: the foe will enter or leave the area.
    """
    to_clear = foe["dist"] + conflict["foe_leave_m"] + foe["half"]
    if to_clear <= 0.0 or (foe["dist"] < foe["half"] and not conflict["near"]):
        return HOLD_NONE
    target = roads.links[link]
    foe_link = roads.links[conflict["foe"]]
    if foe_link["from_lane"] == target["from_lane"]:
        return HOLD_NONE  # the vehicle ahead goes first, see `behind_fork`
    # Distance from the foe's front to the place where it can still stop: its stop line. If the foe
    # has passed that line or cannot stop there, and the shared area is beyond its waiting position
    # on the junction, this position is the place.
    front = foe["dist"] - foe["half"] - roads.lanes[foe_link["from_lane"]]["stop_back_m"]
    comes_last = not (gives_way and conflict["must_yield"])
    if comes_last and front > 0.0 and not _is_committed(foe, front):
        return HOLD_NONE  # early exit for most foes, without reading the VEHICLE row
    wait_m = foe_link["wait_m"]
    other = rows[foe["row"]]
    steered = is_steered(row) or is_steered(other)
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
    # The foe is before its line: both vehicles are assumed to need the whole junction.
    over, assumed_accel = target["length_m"], assumed_accel_of(travel, row)
    if conflict["enter_m"] < target["wait_m"] - LINE_MARGIN_M:
        over = min(over, target["wait_m"])
    passed = (foe["dist"] + foe_link["length_m"] + foe["half"]) / max(foe["speed"], 0.1)
    after_s = GAP_S if conflict["merging"] else 0.0
    if passed + after_s < earliest(distance - half, row["speed"], limit, assumed_accel):
        return HOLD_NONE
    speed, to_line = row["speed"], distance - half
    if not (steered or conflict["merging"]) and speed <= STANDING_MPS:
        # A waiting vehicle counts as being at its line or waiting position, as it would in SUMO.
        inside = to_line < 0.0 and target["wait_m"] < math.inf
        ahead = to_line + target["wait_m"] if inside else to_line
        to_line -= min(max(ahead, 0.0), LINE_MARGIN_M)
    over += min(to_line, 0.0)  # from a waiting position, only the remaining distance counts
    reached = math.sqrt(speed * speed + 2.0 * assumed_accel * max(over, 0.0))
    leaves_mps = min(reached, max(limit, speed))
    time_line = earliest(to_line, speed, limit, GENTLE_SHARE * assumed_accel)
    time_out = time_line + 2.0 * (over + row["length"]) / max(speed + leaves_mps, STANDING_MPS)
    if steered:
        comes = _comes_to_steered(row, conflict, foe, front, leaves_mps, time_out)
    else:
        time_in = earliest(
            distance - half - LINE_MARGIN_M, speed, limit, GENTLE_SHARE * assumed_accel
        )
        comes = _comes(roads, row, conflict, foe, other, time_in, time_out, leaves_mps)
    return HOLD_YIELD if comes else HOLD_NONE
