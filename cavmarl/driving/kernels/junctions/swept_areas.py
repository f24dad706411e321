"""Swept areas: where a vehicle waits because a long or steered vehicle sweeps over its path.

The right of way does not apply there. A vehicle inside the area goes first. Of two vehicles before
the area, the vehicle that is further along goes first, unless it has another reason to wait.
Waiting before a swept area does not change the right of way elsewhere: a driver that yields to the
waiting vehicle may go.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch
from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED, HOLD_NONE
from cavmarl.core.records.rows import (
    SIZE_BODIES_M,
    SIZE_LENGTHS_M,
    STEERED,
    SWEPT_BEYOND_M,
    is_steered,
)
from cavmarl.driving.kernels.junctions.stop_line_registration import (
    APPROACH_STANDING_M,
    STANDING_MPS,
    can_be_ignored,
)
from cavmarl.driving.kernels.models.following import before_line, behind, no_constraint

VAN_M, BUS_M = SIZE_LENGTHS_M
CAR_BODY_M, VAN_BODY_M, BUS_BODY_M = SIZE_BODIES_M
EASY_STOP = 2.0  # m/s²: a vehicle that would have to brake harder is about to enter the area
HARD_STOP = 3.5  # m/s²: a vehicle that would have to brake harder goes first
AT_AREA_M = 0.01  # tolerance: a vehicle stopped right before an area is outside of it
MIN_STOP_M = 0.01  # lower bound of stopping distances
SOON_M = 3.5  # a vehicle this close to the area may enter it at once
LONG_FORK_M = 6.0  # additional distance at a fork until long vehicles are clear of one another
WAIT_EARLIER_M = 3.0  # a long vehicle waits at most this far before the map's waiting position
MOST_BACK_M = 5.0  # a steered car waits at most this far before its line so that others can pass
GIVE_UP_S = 60.0  # after this wait, a vehicle goes on even if the area is occupied


@inlined_kernel
def size_of(half: float) -> int:
    """Return the size class of a vehicle from half its length in m."""
    return int(2.0 * half > VAN_M) + int(2.0 * half > BUS_M)


@inlined_kernel
def _body_m(half: float, size: int) -> float:
    """Return the length in m of a vehicle, at least the body length of its size class."""
    least = VAN_BODY_M if size == 1 else (BUS_BODY_M if size == 2 else CAR_BODY_M)
    return float(max(2.0 * half, least))


@inlined_kernel
def _nothing_sweeps(roads: RoadArrays, size: int, link: int, scratch: Scratch) -> bool:
    """Return whether no vehicle at the junction is large enough to sweep over a car on `link`.

    This is an early exit for most vehicles, which does not read the areas.
    """
    row = roads.links[link]
    nothing: bool = size == 0 and row["swept_by"] > scratch.largest[row["junction"]]
    return nothing


@kernel
def stop_before_foe_sweep(
    roads: RoadArrays,
    rows: NDArray[np.void],  # VEHICLE (C,)
    i: int,  # row of the vehicle
    link: int,  # LINK that the vehicle is on, or takes next
    place: float,  # distance of its front beyond the stop line, m
    # if the vehicle has to stop in any case, it leaves room for foes whose fronts are at most this
    # far (m) before their lines; -inf: it does not have to stop
    room_m: float,
    scratch: Scratch,
) -> float:
    """Return how far beyond its stop line row i may go before a foe sweeps over it.

    The result is in m, for the front of row i; infinite if no foe sweeps over it.
    """
    row = rows[i]
    size = size_of(0.5 * row["length"])
    rear = place - _body_m(0.5 * row["length"], size)
    own = STEERED if size == 0 and is_steered(row) else size
    stop = math.inf
    if _nothing_sweeps(roads, own, link, scratch):
        return stop
    has_left = place > roads.links[link]["length_m"] + 0.5 * row["length"]
    first = roads.links[link]["first_sweep"]
    for k in range(first, first + roads.links[link]["num_sweeps"]):
        sweep = roads.sweeps[k]
        if sweep["own"] > own:
            break  # the rows are sorted by `own`
        if sweep["own"] != own or rear > sweep["leave_m"]:
            continue
        if has_left and place > sweep["enter_m"] + AT_AREA_M:
            continue  # row i has left the junction and is about to clear the area
        if own == STEERED and room_m > 0.0 and -MOST_BACK_M < sweep["enter_m"] <= 0.0:
            stop = min(stop, max(sweep["enter_m"], place))  # wait where no foe sweeps over row i
        same_lane = roads.links[sweep["foe"]]["from_lane"] == roads.links[link]["from_lane"]
        for n in range(scratch.link_start[sweep["foe"]], scratch.link_end[sweep["foe"]]):
            foe = scratch.approach[n]
            other = size_of(foe["half"])
            if other == 0 and own == STEERED and is_steered(rows[foe["row"]]):
                other = STEERED
            if foe["row"] == i or other != sweep["other"]:
                continue
            if same_lane and foe["half"] - foe["dist"] < place:
                continue  # the foe is behind the row
            if own == STEERED and _stands_in_the_way(roads, row, link, place, sweep, foe):
                continue  # the foe has to brake hard in any case, so the row does not stop
            if _is_in_the_way(rows, row, foe, sweep, place, room_m):
                # A vehicle inside the area stops where it is. If the foe is stopped, or may have to
                # stop for the row, the row waits before the junction: otherwise neither could go.
                stop = min(stop, max(sweep["enter_m"], place))
                if place <= 0.0 and (
                    foe["speed"] <= STANDING_MPS or _must_yield(roads, sweep["foe"], link)
                ):
                    stop = min(stop, 0.0)
    return stop


@kernel
def foe_would_sweep_over(
    roads: RoadArrays,
    row: np.void,  # VEHICLE that enters
    link: int,  # next LINK of the vehicle
    place: float,  # distance of its front beyond the stop line, m
    scratch: Scratch,
) -> bool:
    """Return whether a foe would sweep over a vehicle that enters the road here.

    Such a foe is in the area, or could stop before the area only by hard braking. Areas of steered
    cars do not count: otherwise no vehicle could enter where roads overlap.
    """
    own = size_of(0.5 * row["length"])
    if _nothing_sweeps(roads, own, link, scratch):
        return False
    rear = place - _body_m(0.5 * row["length"], own)
    first = roads.links[link]["first_sweep"]
    for k in range(first, first + roads.links[link]["num_sweeps"]):
        sweep = roads.sweeps[k]
        if sweep["own"] > own:
            break  # the rows are sorted by `own`
        if sweep["own"] != own or rear > sweep["leave_m"]:
            continue
        to_area = sweep["enter_m"] - place
        if to_area >= 0.0 and not _needs(row["speed"], to_area, EASY_STOP):
            continue
        for n in range(scratch.link_start[sweep["foe"]], scratch.link_end[sweep["foe"]]):
            foe = scratch.approach[n]
            if size_of(foe["half"]) != sweep["other"]:
                continue
            foe_place = foe["half"] - foe["dist"]
            to_area = sweep["foe_enter_m"] - foe_place
            if foe_place - _body_m(foe["half"], sweep["other"]) <= sweep["foe_leave_m"] and (
                to_area < 0.0 or _needs(foe["speed"], to_area, EASY_STOP)
            ):
                return True
    return False


@kernel
def _must_yield(roads: RoadArrays, link: int, other: int) -> bool:
    """Return whether vehicles on `link` yield to vehicles on `other`."""
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        if roads.conflicts[c]["foe"] == other:
            return bool(roads.conflicts[c]["must_yield"])
    return False


@kernel
def _stands_in_the_way(
    roads: RoadArrays, row: np.void, link: int, place: float, sweep: np.void, foe: np.void
) -> bool:
    """Return whether a row that stops for the sweep of a fast foe would be in the foe's path.

    The front of the row is at `place`, and the foe is before its line. If the row yields, the
    result says whether it would stop beyond the start of the swept area. If the row has the right
    of way, its present place counts.
    """
    front = foe["dist"] - foe["half"]
    if front <= 0.0 or not _needs(foe["speed"], front, HARD_STOP):
        return False
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        if conflict["foe"] == sweep["foe"]:
            if conflict["must_yield"] and place > 0.0:
                place = max(place, sweep["enter_m"])
            elif not _must_yield(roads, sweep["foe"], link):
                return False
            inside: bool = conflict["enter_m"] < place < conflict["leave_m"] + row["length"]
            return inside
    return False


@inlined_kernel
def room_m(at_line: int, inside: int) -> float:
    """Return the argument `room_m` of `stop_before_foe_sweep`, by the reasons to wait (HOLD_*)."""
    if at_line != HOLD_NONE:
        return APPROACH_STANDING_M
    return math.inf if inside != HOLD_NONE else -math.inf


@kernel
def wait_place(roads: RoadArrays, link: int, half: float) -> float:
    """Return the waiting position inside a junction on `link`, in m beyond the stop line.

    The result is the map's waiting position. A long vehicle waits up to `WAIT_EARLIER_M` earlier if
    others would sweep over it. A car waits earlier only if a foe approaches
    (`stop_before_foe_sweep`).
    """
    size = size_of(half)
    wait_m = place = roads.links[link]["wait_m"]
    if size == 0:
        return float(wait_m)
    first = roads.links[link]["first_sweep"]
    for k in range(first, first + roads.links[link]["num_sweeps"]):
        sweep = roads.sweeps[k]
        if sweep["own"] == size and sweep["enter_m"] > max(wait_m - WAIT_EARLIER_M, 0.0):
            place = min(place, sweep["enter_m"])
    return float(place)


@inlined_kernel
def _is_in_the_way(
    rows: NDArray[np.void], row: np.void, foe: np.void, sweep: np.void, place: float, room_m: float
) -> bool:
    """Return whether the vehicle `row`, whose front is at `place`, has to wait for `foe`."""
    foe_place = foe["half"] - foe["dist"]
    foe_rear = foe_place - _body_m(foe["half"], sweep["other"])
    if foe_rear > sweep["foe_leave_m"] or row["wait_s"] > GIVE_UP_S:
        return False
    other = rows[foe["row"]]
    if other["wait_s"] > GIVE_UP_S and other["hold"] == HOLD_EXIT_BLOCKED:
        return False  # the foe waits for the row, which is about to move
    inside = place > sweep["enter_m"] + AT_AREA_M
    foe_inside = foe_place > sweep["foe_enter_m"] + AT_AREA_M
    if foe_inside and not inside:
        return True
    if inside and not foe_inside:
        return False
    to_area = sweep["foe_enter_m"] - foe_place
    comes = room_m > 0.0 and _needs(foe["speed"], to_area, EASY_STOP)
    if not inside and (comes or foe_place > -room_m):
        return True  # the row has to stop anyway, so leaving room costs nothing
    if other["hold"] != HOLD_NONE:
        return False
    if inside:
        return _is_ahead(foe, foe_place, row, place)
    # Background vehicles do not know the areas of steered vehicles, so they do not wait there.
    unaware = sweep["own"] == STEERED and sweep["other"] != STEERED
    own_to_area = sweep["enter_m"] - place
    # If both vehicles can hardly stop before the area, the vehicle that has to brake less waits.
    foe_needs = _decel_to_stop(foe["speed"], to_area)
    own_needs = _decel_to_stop(row["speed"], own_to_area)
    if max(foe_needs, own_needs) > HARD_STOP and foe_needs != own_needs:
        return bool(foe_needs > own_needs)
    soon = to_area < SOON_M or _needs(foe["speed"], to_area, EASY_STOP)
    if unaware:
        return soon and (foe["speed"] > STANDING_MPS or _is_ahead(foe, foe_place, row, place))
    # A foe that can be ignored is blocked by its leader, which may itself wait for this row.
    return soon and not can_be_ignored(other) and _is_ahead(foe, foe_place, row, place)


@inlined_kernel
def _decel_to_stop(speed: float, distance: float) -> float:
    """Return the deceleration in m/s² with which a vehicle stops within a distance."""
    return float(speed * speed / (2.0 * max(distance, MIN_STOP_M)))


@inlined_kernel
def _needs(speed: float, distance: float, decel: float) -> bool:
    """Return whether a stop within a distance needs more deceleration than `decel`."""
    needs: bool = speed * speed > 2.0 * decel * distance
    return needs


@inlined_kernel
def _is_ahead(foe: np.void, foe_place: float, row: np.void, place: float) -> bool:
    ahead: bool = foe_place > place or (foe_place == place and foe["id"] < row["id"])
    return ahead


@inlined_kernel
def before_foe_sweep(
    roads: RoadArrays,
    rows: NDArray[np.void],
    i: int,
    kind: np.void,
    link: int,
    front: float,
    hold: int,
    dt: float,
    scratch: Scratch,
) -> float:
    """Return the constraint on row i of areas that foes sweep.

    `front` is the distance in m from the front to the stop line of the link, negative beyond it.
    `hold` is the reason to wait inside the junction (HOLD_*).
    """
    if roads.links[link]["num_sweeps"] == 0:
        return no_constraint(kind)
    stop = stop_before_foe_sweep(roads, rows, i, link, -front, room_m(HOLD_NONE, hold), scratch)
    return (
        no_constraint(kind)
        if stop == math.inf
        else before_line_gently(kind, rows[i], stop + front, dt)
    )


@kernel
def before_foe_sweep_beyond_junction(
    roads: RoadArrays, rows: NDArray[np.void], i: int, kind: np.void, dt: float, scratch: Scratch
) -> float:
    """Return the constraint of areas that foes sweep beyond the junction; row i has left it."""
    row = rows[i]
    link, half = row["link"], 0.5 * row["length"]
    if row["s"] - half >= SWEPT_BEYOND_M or link < 0 or roads.links[link]["to_lane"] != row["lane"]:
        return no_constraint(kind)
    place = roads.links[link]["length_m"] + row["s"] + half
    return before_foe_sweep(roads, rows, i, kind, link, -place, HOLD_NONE, dt, scratch)


@inlined_kernel
def before_line_gently(kind: np.void, row: np.void, gap: float, dt: float) -> float:
    """Return the constraint of a line, limited so that followers can brake equally hard."""
    constraint = before_line(kind, row["speed"], gap, dt)
    if kind["as_sumo"]:
        return float(min(constraint, kind["decel"] * dt - row["speed"]))
    return float(min(constraint, kind["accel"] + kind["decel"]))


@kernel
def behind_fork(
    roads: RoadArrays,
    kind: np.void,
    row: np.void,
    lane: int,
    chosen: int,  # LINK that the row takes, -1: none
    distance: float,  # from the row's centre to the end of the lane, m; negative beyond it
    dt: float,
    scratch: Scratch,
) -> float:
    """Return the constraint of vehicles that have just left the same lane by another link."""
    constraint = no_constraint(kind)
    first = roads.lanes[lane]["first_link"]
    for link in range(first, first + roads.lanes[lane]["num_links"]):
        if link == chosen:
            continue
        for k in range(scratch.link_start[link], scratch.link_end[link]):
            other = scratch.approach[k]
            place = -other["dist"]
            longest = max(row["length"], 2.0 * other["half"])
            fork_m = roads.links[link]["fork_m"] + (LONG_FORK_M if longest > VAN_M else 0.0)
            if place > max(-distance, 0.0) and place - other["half"] < fork_m:
                gap = distance + place - 0.5 * row["length"] - other["half"]
                constraint = max(
                    constraint, behind(kind, row["speed"], gap, other["speed"], kind["decel"])
                )
            if chosen >= 0 and place + other["half"] > 0.0:
                meeting = _before_meeting_again(roads, kind, row, chosen, distance, other, dt)
                constraint = max(constraint, meeting)
    return constraint


@kernel
def _before_meeting_again(
    roads: RoadArrays,
    kind: np.void,
    row: np.void,
    link: int,
    distance: float,
    other: np.void,
    dt: float,
) -> float:
    """Return the constraint of an APPROACH whose path meets the path of `link` after the fork.

    A vehicle in the shared area goes first; if there is none, the vehicle further from the fork.
    """
    front, foe_front = 0.5 * row["length"] - distance, other["half"] - other["dist"]
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        area = roads.conflicts[c]
        if area["foe"] != other["link"]:
            continue
        if front > area["enter_m"] or foe_front - 2.0 * other["half"] > area["foe_leave_m"]:
            break
        ahead = other["dist"] < distance or (other["dist"] == distance and other["id"] < row["id"])
        if ahead or foe_front > area["foe_enter_m"]:
            return before_line(kind, row["speed"], area["enter_m"] - front, dt)
    return no_constraint(kind)
