"""Right of way: who approaches which link, and whether a driver may enter one.

Every vehicle announces itself to the links ahead on its way and to the one it is on. A driver
enters a link if no foe is in the shared area when it would be, if it gives way to those it must
give way to, and if there is room behind the junction. All questions are minima and any-ofs over the
foes: the order of rows plays no part.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import RoadArrays, Scratch
from cavmarl.kernels.codes import (
    DRIVER_AGENT,
    HOLD_EXIT_BLOCKED,
    HOLD_NONE,
    HOLD_SIGNAL,
    HOLD_YIELD,
    SIGNAL_GREEN_MAJOR,
    SIGNAL_NONE,
    SIGNAL_OFF,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_STOP_THEN_GO,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.kernels.lanes import last_on_lane

__all__ = [
    "APPROACH_M",
    "STOP_SIGN_S",
    "conflict_inside",
    "link_signal",
    "may_enter",
    "register_links",
]

APPROACH_M = 150.0  # how far ahead a vehicle announces itself to links
MAX_LINKS_AHEAD = 2
ENTRY_ACCEL = 2.5  # m/s², how a driver thinks others and itself speed up over a junction
COMFORT_STOP = 3.0  # m/s², a driver stops for yellow where this braking is enough
HARD_STOP = 5.0  # m/s², a vehicle that needs more to stop before the line will not stop
GAP_S = 1.0  # s between the last of one and the first of the other in a shared area
STEERED_MPS = 5.0  # a steered car is taken to turn no faster than this
STANDING_MPS = 0.5
LAST_CHANCE_M = 3.0  # with the front this near to the line
ROOM_M = 3.0  # free way left behind a vehicle that clears a junction
IMPATIENT_S = 3.0  # a vehicle that stands this long without reason is not waited for
STOP_SIGN_S = 0.5  # how long one stands at a stop sign, and before a tie is broken
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
def register_links(
    roads: RoadArrays,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    num: int,
    scratch: Scratch,
) -> None:
    """List for every link the vehicles that are on it or will reach it, into `scratch.link_*`.

    Args:
        roads: the road arrays.
        plans: PLAN (G, L).
        rows: VEHICLE (C,), of which `num` live.
        num: live rows.
        scratch: link_start, link_row, link_dist are written. The distance is that of the vehicle's
            centre to the stop line, negative beyond it.
    """
    pairs = 0
    for i in range(num):
        pairs = _announce(roads, plans, rows[i], i, pairs, scratch)
    start = scratch.link_start
    num_links = roads.links.shape[0]
    start[: num_links + 2] = 0
    for k in range(pairs):
        start[scratch.pair_link[k] + 2] += 1
    for link in range(num_links):
        start[link + 2] += start[link + 1]
    for k in range(pairs):
        link = scratch.pair_link[k]
        place = start[link + 1]
        scratch.link_row[place] = scratch.pair_row[k]
        scratch.link_dist[place] = scratch.pair_dist[k]
        start[link + 1] = place + 1


@kernel
def _announce(
    roads: RoadArrays,
    plans: NDArray[np.void],
    row: np.void,
    i: int,
    pairs: int,
    scratch: Scratch,
) -> int:
    """Append row i's (link, distance) pairs; returns the new number of pairs."""
    lane = row["lane"]
    here = roads.lanes[lane]
    if here["internal"]:
        scratch.pair_link[pairs] = here["link"]
        scratch.pair_row[pairs] = i
        scratch.pair_dist[pairs] = -(here["link_offset_m"] + row["s"])
        pairs += 1
    elif row["link"] >= 0 and row["s"] < 0.5 * row["length"]:
        # Its centre has left the junction, its rear has not.
        left = row["link"]
        if roads.links[left]["to_lane"] == lane:
            scratch.pair_link[pairs] = left
            scratch.pair_row[pairs] = i
            scratch.pair_dist[pairs] = -(roads.links[left]["length_m"] + row["s"])
            pairs += 1
    distance = here["length_m"] - row["s"]
    found = 0
    while distance < APPROACH_M and found < MAX_LINKS_AHEAD:
        step = plans[row["goal"], lane]
        if step["next"] < 0:
            break
        if step["link"] >= 0:
            scratch.pair_link[pairs] = step["link"]
            scratch.pair_row[pairs] = i
            scratch.pair_dist[pairs] = max(distance, 0.0)
            pairs += 1
            found += 1
        lane = step["next"]
        distance += roads.lanes[lane]["length_m"]
    return pairs


@kernel
def _earliest(distance: float, speed: float, limit: float) -> float:
    """Time in s to drive `distance` m when speeding up with ENTRY_ACCEL to `limit` m/s."""
    if distance <= 0.0:
        return 0.0
    limit = max(limit, speed, 0.1)
    ramp = (limit * limit - speed * speed) / (2.0 * ENTRY_ACCEL)
    if distance < ramp:
        return (math.sqrt(speed * speed + 2.0 * ENTRY_ACCEL * distance) - speed) / ENTRY_ACCEL
    return (limit - speed) / ENTRY_ACCEL + (distance - ramp) / limit


@kernel
def _ignores(row: np.void, foe: np.void, link: int, signal: int) -> bool:
    """Whether a driver at `link` need not wait for an approaching foe that has the right of way.

    `signal` is what the foe's own signal shows.
    """
    if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
        return True
    if signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR:
        return True  # who cannot stop any more has been looked at before
    if foe["speed"] > STANDING_MPS:
        return False
    if foe["hold"] == HOLD_SIGNAL or foe["hold"] == HOLD_EXIT_BLOCKED:
        return True
    if foe["hold"] == HOLD_YIELD:
        # Both wait for somebody: who has stood longer goes first, and then goes on.
        if row["hold"] == HOLD_NONE and row["stopped_at"] == link:
            return True
        if row["wait_s"] < STOP_SIGN_S or row["speed"] > STANDING_MPS:
            return False
        longer: bool = row["wait_s"] > foe["wait_s"]
        return longer or (row["wait_s"] == foe["wait_s"] and row["id"] < foe["id"])
    waited: bool = foe["wait_s"] > IMPATIENT_S
    return waited


@kernel
def _blocked_by_foes(
    roads: RoadArrays,
    rows: NDArray[np.void],
    i: int,
    link: int,
    distance: float,
    gives_way: bool,
    phase: NDArray[np.int32],
    scratch: Scratch,
) -> bool:
    """Whether a foe is, or will be, where row i would be on `link`, `distance` m from its line."""
    row = rows[i]
    half = 0.5 * row["length"]
    limit = roads.lanes[roads.links[link]["next_lane"]]["speed_mps"]
    if row["driver"] == DRIVER_AGENT:
        limit = min(limit, STEERED_MPS)
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        foe_link = conflict["foe"]
        begin = scratch.link_start[foe_link]
        end = scratch.link_start[foe_link + 1]
        if begin == end:
            continue
        time_in = _earliest(distance + conflict["enter_m"] - half, row["speed"], limit)
        time_out = _earliest(distance + conflict["leave_m"] + half, row["speed"], limit)
        foe_signal = link_signal(roads, foe_link, phase)
        for k in range(begin, end):
            j = scratch.link_row[k]
            if j == i:
                continue
            foe = rows[j]
            foe_half = 0.5 * foe["length"]
            foe_distance = scratch.link_dist[k]
            to_clear = foe_distance + conflict["foe_leave_m"] + foe_half
            if to_clear <= 0.0:
                continue
            cleared = to_clear / max(foe["speed"], 0.1)
            if foe_distance - foe_half <= 0.0 and foe_distance <= 0.0:
                if cleared + 0.5 * GAP_S > time_in:
                    return True
                continue
            front = max(foe_distance - foe_half, 0.01)
            committed = foe["speed"] * foe["speed"] > 2.0 * HARD_STOP * front
            if not committed:
                if not (gives_way and conflict["must_yield"]) or _ignores(
                    row, foe, link, foe_signal
                ):
                    continue
            if cleared + GAP_S < time_in:
                continue
            foe_limit = roads.lanes[roads.links[foe_link]["from_lane"]]["speed_mps"]
            arrives = _earliest(
                foe_distance + conflict["foe_enter_m"] - foe_half, foe["speed"], foe_limit
            )
            if arrives < time_out + GAP_S:
                return True
    return False


@kernel
def _exit_blocked(
    roads: RoadArrays, rows: NDArray[np.void], i: int, link: int, scratch: Scratch
) -> bool:
    """Whether there is no room for row i between the junction and the last vehicle behind it."""
    target = roads.links[link]
    j, s = last_on_lane(i, target["to_lane"], scratch)
    if j < 0 or rows[j]["speed"] > 2.0:
        return False
    room = s - 0.5 * rows[j]["length"]
    lane = target["next_lane"]
    while roads.lanes[lane]["internal"]:
        for k in range(scratch.lane_start[lane], scratch.lane_start[lane + 1]):
            other = scratch.entry_row[k]
            if other != i:
                room -= rows[other]["length"] + ROOM_M
        lane = roads.lanes[lane]["successor"]
    blocked: bool = room < rows[i]["length"] + ROOM_M
    return blocked


@kernel
def may_enter(
    roads: RoadArrays,
    rows: NDArray[np.void],
    i: int,
    link: int,
    distance: float,
    phase: NDArray[np.int32],
    scratch: Scratch,
) -> int:
    """Whether row i may drive into `link`: HOLD_NONE, or why it has to stop at the line.

    Args:
        roads: the road arrays.
        rows: VEHICLE (C,).
        i: the row that asks.
        link: LINK row.
        distance: of its centre to the stop line in m.
        phase: (num_signals,) PHASE rows that are on.
        scratch: with the lane and link indices of this tick.
    """
    row = rows[i]
    signal = link_signal(roads, link, phase)
    front = max(distance - 0.5 * row["length"], 0.01)
    needed = row["speed"] * row["speed"] / (2.0 * front)
    if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
        return HOLD_SIGNAL
    if (signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR) and needed < COMFORT_STOP:
        # Who gave way at the line all through green goes now, as the others stop.
        if row["hold"] != HOLD_YIELD or front > LAST_CHANCE_M:
            return HOLD_SIGNAL
    target = roads.links[link]
    if target["num_conflicts"] == 0:
        return HOLD_NONE
    state = target["state"]
    must_stop = signal == SIGNAL_STOP_THEN_GO or (
        signal == SIGNAL_NONE and (state == STATE_STOP or state == STATE_ALLWAY_STOP)
    )
    if must_stop and row["stopped_at"] != link:
        return HOLD_YIELD
    gives_way = signal != SIGNAL_GREEN_MAJOR and signal != SIGNAL_OFF
    if _blocked_by_foes(roads, rows, i, link, distance, gives_way, phase, scratch):
        return HOLD_YIELD
    if _exit_blocked(roads, rows, i, link, scratch):
        return HOLD_EXIT_BLOCKED
    return HOLD_NONE


@kernel
def conflict_inside(
    roads: RoadArrays, rows: NDArray[np.void], i: int, link: int, place: float, scratch: Scratch
) -> float:
    """Way in m from row i's front to where it has to stop for a foe on the same junction, or inf.

    `place` is row i's centre on the link, m from its stop line. Of two vehicles in conflict the one
    that is nearer to the shared area goes first; at equal distance the smaller id.
    """
    row = rows[i]
    front = place + 0.5 * row["length"]
    nearest = math.inf
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        to_area = conflict["enter_m"] - front
        if to_area < 0.0 or to_area >= nearest:
            continue
        foe_link = conflict["foe"]
        for k in range(scratch.link_start[foe_link], scratch.link_start[foe_link + 1]):
            foe = rows[scratch.link_row[k]]
            foe_place = -scratch.link_dist[k]
            foe_half = 0.5 * foe["length"]
            if foe_place < 0.0 or foe_place - foe_half > conflict["foe_leave_m"]:
                continue
            foe_to_area = conflict["foe_enter_m"] - foe_place - foe_half
            if foe_to_area < to_area or (foe_to_area == to_area and foe["id"] < row["id"]):
                nearest = to_area
                break
    return nearest
