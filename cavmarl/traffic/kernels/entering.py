"""The place and speed at which a waiting departure enters, and whether it can enter now.

A departure requests a lane of its edge, a place on that lane and a speed, as numbers or as SUMO's
keywords. It enters only if the gap is safe for itself and for its follower.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.rng import STREAM_DEPARTURE, STREAM_PLACE, below, uniform
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
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
from cavmarl.driving.kernels.junctions.swept_areas import LONG_FORK_M
from cavmarl.driving.kernels.lanes.adjacent_leaders import next_askew
from cavmarl.driving.kernels.lanes.lane_index import ahead_on, behind_by, first_from, last_on
from cavmarl.driving.kernels.lanes.route_following import next_step
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M
from cavmarl.driving.kernels.models.following import accel_behind, speed_behind
from cavmarl.roads.kernels.lanes_now import is_closed

ENTER_GAP_M = 1.0  # m between bumpers, minimum gap of an entering vehicle
LEADER_M = 150.0  # m; search distance for a leader
ENTER_DECEL = 2.0  # m/s², maximum braking imposed on a follower, or needed at the lane's end
BEST_LANE_M = 3000.0  # m; lanes that a route can follow this far are equally good, as in SUMO
SAME_LENGTH = 0.99  # lanes with this share of the best distance count as equal, because of bends
DRAW_LANE = 0  # offset of draws in STREAM_DEPARTURE
DRAW_SPEED = 1


@kernel
def _may_use(roads: RoadArrays, travel: TripTables, departure: np.void, lane: int) -> bool:
    usable: bool = travel.steps[departure["way"] + lane]["to_go"] < math.inf
    return usable and not is_closed(roads, lane, travel.types[departure["vtype"]])


@kernel
def crowd(scratch: Scratch, lane: int, s: float, view_m: float) -> int:
    """Count the vehicles in view of a place on a lane."""
    found = 0
    for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
        found += abs(scratch.entries[k]["s"] - s) <= view_m
    return found


@kernel
def entry_lane(
    roads: RoadArrays,
    travel: TripTables,
    key: np.uint64,
    departure: np.void,
    ranks: NDArray[np.int64],
    taken: NDArray[np.bool_],
) -> int:
    """Return the LANE row where a departure enters in this tick, or -1 if it must wait.

    A departure that chooses by traffic takes the usable lane with the fewest vehicles (with `best`,
    among the lanes that its route follows furthest without a lane change); on a tie, the right
    lane.

    `roads`: roads of the world. `ranks`: vehicles near the place on each lane of the edge, read if
    the departure chooses by traffic. `taken`: (L,) lanes on which another departure tries to enter
    in this tick.
    """
    code = departure["lane_code"]
    if code == LANE_GIVEN:
        kind = travel.types[departure["vtype"]]
        waits = taken[departure["lane"]] or is_closed(roads, departure["lane"], kind)
        return -1 if waits else departure["lane"]
    edge = roads.edges[roads.lanes[departure["lane"]]["edge"]]
    first = edge["first_lane"]
    end = first + edge["num_lanes"]
    usable = 0
    furthest = 0.0  # largest distance in m that the route follows a lane without a lane change
    for lane in range(first, end):
        if _may_use(roads, travel, departure, lane):
            usable += 1
            furthest = max(furthest, travel.steps[departure["way"] + lane]["room"])
    furthest = SAME_LENGTH * min(furthest, BEST_LANE_M)
    pick = -1
    if code == LANE_RANDOM and usable > 0:
        pick = below(key, departure["id"], 0, STREAM_DEPARTURE + DRAW_LANE, usable)
    best = -1
    best_rank = 1 << 40
    for lane in range(first, end):
        if not _may_use(roads, travel, departure, lane):
            continue
        if code == LANE_RANDOM:
            if pick == 0:
                return -1 if taken[lane] else lane
            pick -= 1
            continue
        if code == LANE_FIRST:
            return -1 if taken[lane] else lane
        is_good = code != LANE_BEST or travel.steps[departure["way"] + lane]["room"] >= furthest
        if taken[lane] or not is_good:
            continue  # if all of the best lanes are taken, the departure waits
        rank = ranks[lane - first]
        if rank < best_rank:
            best = lane
            best_rank = rank
    return best


@kernel
def entry_place(
    roads: RoadArrays,
    travel: TripTables,
    key: np.uint64,
    departure: np.void,
    kind: np.void,
    lane: int,
    tick: int,
    scratch: Scratch,
) -> float:
    """Return the position on its lane at which the centre of a departure enters, in m.

    The front is before the line and the rear is on the lane. If the lane is shorter than the body,
    the rear is before the start of the lane.
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
        s = most - _behind_last_m(roads, travel, key, departure, kind, lane, most, scratch)
    else:
        s = half + (most - half) * uniform(key, departure["id"], tick, STREAM_PLACE)
    return float(min(max(s, half), max(length - half - LINE_MARGIN_M, 0.0)))


@kernel
def speed_at(roads: RoadArrays, kind: np.void, lane: int, s: float, wanted: float) -> float:
    """Return `wanted`, limited by the vehicle's maximum and by braking at the lane's end."""
    rest = max(roads.lanes[lane]["length_m"] - s - 0.5 * kind["length"] - 2.0, 0.0)
    return float(min(wanted, kind["max_speed"], math.sqrt(2.0 * ENTER_DECEL * rest)))


@kernel
def _line_speed(
    roads: RoadArrays,
    travel: TripTables,
    departure: np.void,
    kind: np.void,
    lane: int,
    s: float,
    wanted: float,
) -> float:
    """Return `wanted`, limited so that the vehicle can brake for stops and lower limits ahead."""
    way = departure["way"]
    rest = max(roads.lanes[lane]["length_m"] - s - 0.5 * kind["length"] - 2.0, 0.0)
    while wanted * wanted > 2.0 * ENTER_DECEL * rest:
        lane, way, link = next_step(roads, travel, lane, way)
        stops = lane < 0
        if link >= 0:
            stops |= roads.links[link]["num_conflicts"] > 0 or roads.links[link]["signal"] >= 0
        limit = 0.0 if stops else roads.lanes[lane]["speed_mps"] * departure["speed_factor"]
        wanted = min(wanted, math.sqrt(limit * limit + 2.0 * ENTER_DECEL * rest))
        if stops:
            break
        rest += roads.lanes[lane]["length_m"]
    return float(wanted)


@kernel
def _wanted_speed(
    roads: RoadArrays,
    travel: TripTables,
    key: np.uint64,
    departure: np.void,
    kind: np.void,
    lane: int,
    s: float,
    leader: int,
    scratch: Scratch,
) -> float:
    """Return the speed in m/s at which a departure would enter at `s` if the lane had no end.

    `leader`: the entry of the leader, or -1.
    """
    here = roads.lanes[lane]
    code = departure["speed_code"]
    wanted = here["speed_mps"] * departure["speed_factor"]
    if code == SPEED_GIVEN:
        wanted = min(departure["speed"], wanted)
    elif code == SPEED_RANDOM:
        wanted *= uniform(key, departure["id"], 0, STREAM_DEPARTURE + DRAW_SPEED)
    elif code == SPEED_LIMIT:
        wanted = min(wanted, here["speed_mps"])
    elif code == SPEED_AVERAGE:
        wanted = min(wanted, _mean_speed(here["speed_mps"], lane, s, travel.view_m, scratch))
    elif code == SPEED_LAST and leader >= 0:
        wanted = min(wanted, scratch.entries[leader]["speed"])
    return float(min(wanted, kind["max_speed"]))


@kernel
def _behind_last_m(
    roads: RoadArrays,
    travel: TripTables,
    key: np.uint64,
    departure: np.void,
    kind: np.void,
    lane: int,
    most: float,
    scratch: Scratch,
) -> float:
    """Return the distance in m from a POS_LAST departure's place to `most`, the last place.

    Behind the last vehicle in view of the lane's end, the departure keeps the gap that it needs to
    stop. Without such a vehicle it keeps its reaction time to the end, because there may be
    vehicles beyond the end. Vehicles out of view are unknown to the zone of the lane's end.
    """
    k = first_from(scratch, lane, roads.lanes[lane]["length_m"] - travel.view_m, departure["id"])
    wanted = _wanted_speed(roads, travel, key, departure, kind, lane, most, k, scratch)
    if k < 0:
        at_end = _line_speed(roads, travel, departure, kind, lane, most, wanted)
        return float(at_end * kind["tau"])
    last = scratch.entries[k]
    speed = _line_speed(roads, travel, departure, kind, lane, 0.0, wanted)
    gap = kind["min_gap"] + _secure_m(kind, speed, last)
    return float(most - (last["s"] - last["half"] - gap - 0.5 * kind["length"]))


@inlined_kernel
def _secure_m(kind: np.void, speed: float, leader: np.void) -> float:
    """Return the gap in m, beyond the minimum, needed to stop behind a stopping leader."""
    stops_m = speed * speed / (2.0 * kind["decel"])
    leader_m = leader["speed"] * leader["speed"] / (2.0 * leader["decel"])
    return float(max(speed * kind["tau"] + stops_m - leader_m, 0.0))


@kernel
def entry_speed(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    key: np.uint64,
    departure: np.void,
    kind: np.void,
    lane: int,
    s: float,
    scratch: Scratch,
) -> float:
    """Return the speed in m/s at which a departure can enter; -1: its leader is too near.

    An agent that is changing lanes and still covers a part of this lane also counts as a leader.
    """
    half = 0.5 * kind["length"]
    j = ahead_on(scratch, lane, s, departure["id"], travel.view_m)
    safe = math.inf
    if j < 0:
        safe = _safe_at_fork(roads, travel, departure, kind, lane, s, scratch)
    distance, beyond, way = -s, lane, departure["way"]
    while j < 0:
        distance += roads.lanes[beyond]["length_m"]
        beyond, way, _ = next_step(roads, travel, beyond, way)
        if beyond < 0 or distance > LEADER_M:
            break
        j = last_on(scratch, beyond, departure["id"], distance, travel.view_m)
    wanted = _wanted_speed(roads, travel, key, departure, kind, lane, s, j, scratch)
    wanted = _line_speed(roads, travel, departure, kind, lane, s, wanted)
    if j >= 0:
        ahead = distance + scratch.entries[j]["s"] - half
        safe = min(safe, _safe_behind(kind, scratch.entries[j], ahead))
    for to_left in (True, False):
        k, apart = next_askew(roads, travel, rows, lane, s, departure["id"], to_left, scratch)
        if k >= 0:
            safe = min(safe, _safe_behind(kind, scratch.entries[k], apart - half))
    # With POS_LAST or a fixed speed, the departure waits until its wanted speed is safe.
    code = departure["speed_code"]
    slows = (code == SPEED_MAX or code == SPEED_RANDOM) and departure["pos_code"] != POS_LAST
    if safe < 0.0 or (safe < wanted and not slows):
        return -1.0
    return min(wanted, safe)


@kernel
def _safe_at_fork(
    roads: RoadArrays,
    travel: TripTables,
    departure: np.void,
    kind: np.void,
    lane: int,
    s: float,
    scratch: Scratch,
) -> float:
    """Return the safe speed in m/s behind vehicles that have just turned off from the lane.

    Only vehicles whose rear is before the fork count. -1: a vehicle is too near; inf: no vehicle.
    """
    here = roads.lanes[lane]
    to_end = here["length_m"] - s
    safe = math.inf
    if to_end > LEADER_M:
        return safe
    for link in range(here["first_link"], here["first_link"] + here["num_links"]):
        beyond = roads.links[link]["next_lane"]
        k = last_on(scratch, beyond, departure["id"], to_end, travel.view_m)
        if k < 0:
            continue
        other = scratch.entries[k]
        if other["s"] - other["half"] < roads.links[link]["fork_m"]:
            found = _safe_behind(kind, other, to_end + other["s"] - 0.5 * kind["length"])
            safe = min(safe, found)
    return safe


@kernel
def _mean_speed(limit_mps: float, lane: int, s: float, view_m: float, scratch: Scratch) -> float:
    """Return the mean speed in m/s of vehicles on a lane in view of `s`; the limit if none."""
    total, number = 0.0, 0
    for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
        other = scratch.entries[k]
        if not other["side"] and abs(other["s"] - s) <= view_m:
            total += other["speed"]
            number += 1
    return total / number if number > 0 else limit_mps


@kernel
def _safe_behind(kind: np.void, leader: np.void, to_centre: float) -> float:
    """Return the safe speed in m/s behind an entry `to_centre` m ahead; -1: too near."""
    gap = to_centre - leader["half"]
    if gap < ENTER_GAP_M:
        return -1.0
    return speed_behind(kind, gap, leader["speed"], leader["decel"])


@kernel
def follower_brakes(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    departure: np.void,
    kind: np.void,
    lane: int,
    s: float,
    speed: float,
    scratch: Scratch,
) -> bool:
    """Return whether a follower on any lane would have to brake hard for an entrant."""
    half = 0.5 * kind["length"]
    for n in range(max(1, roads.lanes[lane]["num_into"])):
        k, apart = behind_by(
            roads, scratch, lane, s, departure["id"], n, ENTER_REACH_M, travel.view_m
        )
        if k >= 0 and _brakes(roads, travel, rows, kind, lane, k, apart - half, speed, scratch):
            return True
    return _one_that_turns_off_brakes(roads, travel, rows, kind, lane, s, speed, scratch)


@kernel
def _one_that_turns_off_brakes(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    kind: np.void,
    lane: int,
    s: float,
    speed: float,
    scratch: Scratch,
) -> bool:
    """Return whether a vehicle on another turn from a previous lane brakes hard for an entrant.

    Such vehicles turn to another lane, but their bodies still cover a part of the entrant's lane.
    """
    half = 0.5 * kind["length"]
    here = roads.lanes[lane]
    for n in range(here["num_into"]):
        into = roads.lanes[roads.into[here["first_into"] + n]]
        if not into["internal"]:
            continue
        own = into["link"]
        rear = roads.links[own]["length_m"] + s - half
        start = roads.lanes[roads.links[own]["from_lane"]]
        for link in range(start["first_link"], start["first_link"] + start["num_links"]):
            if link == own or rear > roads.links[link]["fork_m"] + LONG_FORK_M:
                continue
            inside = roads.links[link]["next_lane"]
            while roads.lanes[inside]["internal"]:
                offset = roads.lanes[inside]["link_offset_m"]
                for k in range(scratch.lane_start[inside], scratch.lane_end[inside]):
                    apart = rear - offset - scratch.entries[k]["s"]
                    if _brakes(roads, travel, rows, kind, lane, k, apart, speed, scratch):
                        return True
                inside = roads.lanes[inside]["successor"]
    return False


@kernel
def _brakes(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    kind: np.void,
    lane: int,
    k: int,
    apart: float,
    speed: float,
    scratch: Scratch,
) -> bool:
    """Return whether entry k brakes hard; its centre is `apart` m behind the entrant's rear."""
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
