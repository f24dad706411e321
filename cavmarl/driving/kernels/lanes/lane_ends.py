"""Constraints of the end of a lane: room for a lane change, and bodies that reach over the end."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import HOLD_NONE
from cavmarl.core.records.rows import is_steered
from cavmarl.driving.kernels.junctions.swept_areas import VAN_M, before_foe_sweep, behind_fork
from cavmarl.driving.kernels.lanes.adjacent_leaders import behind_adjacent_leader, behind_entry
from cavmarl.driving.kernels.lanes.lane_choice import LEAST_SWAP_M, MERGE_ROOM_SHARE, SWAP_ROOM_M
from cavmarl.driving.kernels.lanes.lane_index import beside_s, last_on
from cavmarl.driving.kernels.lanes.route_following import next_step
from cavmarl.driving.kernels.lanes.side_clearance import LONGEST_HALF_M
from cavmarl.driving.kernels.models.car_following_model import LINE_MARGIN_M
from cavmarl.driving.kernels.models.following import before_line, behind, no_constraint


@kernel
def lane_end(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    kind: np.void,
    lane: int,
    way: int,
    distance: float,
    merge_room_m: float,
    dt: float,
) -> float:
    """Return the constraint of a lane's end, unless the route continues or ends on this lane."""
    step = travel.steps[way + lane]
    if step["to_go"] < math.inf and step["change"] == 0:
        return no_constraint(kind)
    # Stop with enough room to swing out, but not before the start of this lane.
    length = roads.lanes[lane]["length_m"]
    half = 0.5 * row["length"]
    room = min(merge_room_m, MERGE_ROOM_SHARE * length)
    if step["change"] > 0 and merge_room_m > 0.0:
        swap = SWAP_ROOM_M
        # Background vehicles need no room to steer; on short lanes their rear has to fit.
        if not is_steered(row):
            swap = min(swap, length - room - 2.0 * (row["length"] + LINE_MARGIN_M))
            swap = max(swap, LEAST_SWAP_M)
        room += row["length"] + swap
    place = max(length - half - room, min(2.0 * LINE_MARGIN_M, 0.5 * length))
    return before_line(kind, row["speed"], distance - length + place, dt)


@kernel
def behind_turning(
    roads: RoadArrays, kind: np.void, row: np.void, lane: int, distance: float, scratch: Scratch
) -> float:
    """Return the constraint of long vehicles that turn from a lane adjacent to a dead end.

    `distance` is from the row's centre to the end of that lane in m. The rears of long vehicles
    swing out over the lane; without a link, the lane has no swept areas.
    """
    constraint = no_constraint(kind)
    for neighbor in (roads.lanes[lane]["left"], roads.lanes[lane]["right"]):
        if neighbor < 0:
            continue
        first = roads.lanes[neighbor]["first_link"]
        for link in range(first, first + roads.lanes[neighbor]["num_links"]):
            for k in range(scratch.link_start[link], scratch.link_end[link]):
                other = scratch.approach[k]
                rear = -other["dist"] - other["half"]
                gap = distance - 0.5 * row["length"] + rear
                if 2.0 * other["half"] <= VAN_M or gap < 0.0 or rear > 0.0:
                    continue
                if other["half"] > other["dist"]:
                    found = behind(kind, row["speed"], gap, other["speed"], kind["decel"])
                    constraint = max(constraint, found)
    return constraint


@kernel
def misses_last_change(roads: RoadArrays, travel: TripTables, lane: int, way: int) -> bool:
    """Return whether a missed lane change would lead to a turn that a steered car cannot take."""
    if roads.lanes[lane]["internal"]:
        return False
    step = travel.steps[way + lane]
    if step["link"] < 0 or step["change"] == 0:
        return False
    beyond = travel.steps[way + step["shift"] + roads.links[step["link"]]["to_lane"]]
    misses: bool = beyond["turnarounds"] > step["turnarounds"]
    return misses


@kernel
def behind_over_line(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    kind: np.void,
    lane: int,
    way: int,
    distance: float,
    scratch: Scratch,
) -> float:
    """Return the constraint of a vehicle on short lanes ahead whose rear is before the line.

    `lane` is the first lane behind the line, which is `distance` m ahead.
    """
    line = distance
    while distance - line < LONGEST_HALF_M:
        distance += roads.lanes[lane]["length_m"]
        lane, way, _ = next_step(roads, travel, lane, way)
        if lane < 0:
            break
        j = last_on(scratch, lane, row["id"], distance, travel.view_m)
        if j >= 0:
            leader = scratch.entries[j]
            rear = distance + leader["s"] - leader["half"]
            if rear < line:
                return behind_entry(kind, row["speed"], rear - 0.5 * row["length"], leader)
            break
    return no_constraint(kind)


@inlined_kernel
def constraint_over_lane_end(
    roads: RoadArrays,
    rows: NDArray[np.void],
    i: int,
    kind: np.void,
    lane: int,
    distance: float,
    is_near: bool,
    dt: float,
    scratch: Scratch,
) -> float:
    """Return the constraint on row i of bodies that reach over the end of a lane.

    The end is `distance` m ahead. The rear of a vehicle that has left the lane by any link may
    still reach over the end. If the end `is_near`, a background driver also waits for vehicles that
    sweep over it.
    """
    row = rows[i]
    constraint = behind_fork(roads, kind, row, lane, -1, distance, dt, scratch)
    if not is_near or is_steered(row):
        return constraint
    if roads.lanes[lane]["num_links"] == 0:
        return max(constraint, behind_turning(roads, kind, row, lane, distance, scratch))
    first, front = roads.lanes[lane]["first_link"], distance - 0.5 * row["length"]
    swept = before_foe_sweep(roads, rows, i, kind, first, front, HOLD_NONE, dt, scratch)
    return max(constraint, swept)


@kernel
def constraint_of_side_lane(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    kind: np.void,
    see_m: float,
    dt: float,
    scratch: Scratch,
) -> float:
    """Return the constraint of the adjacent lane that the body of row i still covers.

    Vehicles that sweep over the end of that lane count if the end is at most `see_m` m ahead.
    """
    row = rows[i]
    lane = row["side_lane"]
    constraint = behind_adjacent_leader(roads, travel, kind, row, lane, scratch)
    distance = roads.lanes[lane]["length_m"] - beside_s(roads, row["lane"], lane, row["s"])
    if distance > 0.5 * row["length"]:
        over = constraint_over_lane_end(
            roads, rows, i, kind, lane, distance, distance < see_m, dt, scratch
        )
        constraint = max(constraint, over)
    return constraint
