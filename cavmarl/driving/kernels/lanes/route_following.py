"""Route following: the lane and the link that a vehicle takes at the end of a lane.

All plans are stored in one table, `TripTables.steps`. A vehicle's `way` is an offset into it: the
step of a lane outside junctions is `steps[way + lane]`. The plan of a goal covers every lane, so
the `way` of such a vehicle never changes. An explicit route has steps for its own edges only, edge
by edge; each step contains the change of `way` on the next edge. Inside junctions, a lane has one
successor.
"""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, TripTables
from cavmarl.roads.kernels.signal_phases import program_at

MOST_CHANGES = 8  # largest number of lane changes at the end of one lane


@inlined_kernel
def own_step(roads: RoadArrays, row: np.void) -> int:
    """Return the `TripTables.steps` row of a vehicle's lane or, in a junction, of the next lane."""
    lane = row["lane"]
    if roads.lanes[lane]["internal"]:
        lane = roads.links[roads.lanes[lane]["link"]]["to_lane"]
    return int(row["way"] + lane)


@inlined_kernel
def next_step_from(roads: RoadArrays, step: np.void, lane: int, way: int) -> tuple[int, int, int]:
    """Return `next_step` from a vehicle's own lane, whose PLAN `step` is known."""
    if roads.lanes[lane]["internal"]:
        return roads.lanes[lane]["successor"], way, -1
    return step["next"], way + step["shift"], step["link"]


@inlined_kernel
def next_step(roads: RoadArrays, travel: TripTables, lane: int, way: int) -> tuple[int, int, int]:
    """Return the next lane after the end of a lane, the `way` on it, and the link to it.

    The lane is -1 if the route ends or continues from another lane. The link is -1 inside
    junctions.
    """
    if roads.lanes[lane]["internal"]:
        return roads.lanes[lane]["successor"], way, -1
    step = travel.steps[way + lane]
    return step["next"], way + step["shift"], step["link"]


@inlined_kernel
def fed_lane(roads: RoadArrays, lane: int) -> int:
    """Return a lane or, if no link leads to it, an adjacent lane to which a link leads."""
    row = roads.lanes[lane]
    if row["num_into"] == 0:
        for side in (row["left"], row["right"]):
            if side >= 0 and roads.lanes[side]["num_into"] > 0:
                return int(side)
    return lane


@inlined_kernel
def distance_left(roads: RoadArrays, row: np.void, step: np.void) -> float:
    """Return the distance in m from a vehicle's centre to the end of its route, or inf.

    `step` is the PLAN of the vehicle's lane.
    """
    here = roads.lanes[row["lane"]]
    left = -row["s"]
    if here["internal"]:
        left += roads.links[here["link"]]["length_m"] - here["link_offset_m"]
    return float(step["to_go"] + left)


@kernel
def next_step_of_plan(
    roads: RoadArrays, travel: TripTables, lane: int, way: int
) -> tuple[int, int, int]:
    """Return `next_step`, after the lane changes that the plan needs on this edge."""
    for _ in range(MOST_CHANGES):
        following, way_there, link = next_step(roads, travel, lane, way)
        if following >= 0 or roads.lanes[lane]["internal"]:
            return following, way_there, link
        change = travel.steps[way + lane]["change"]
        if change == 0:
            break
        lane = roads.lanes[lane]["left"] if change > 0 else roads.lanes[lane]["right"]
        if lane < 0:
            break
    return -1, way, -1


@inlined_kernel
def free_speed(lane: np.void, kind: np.void, speed_factor: float) -> float:
    """Return the speed in m/s of a vehicle alone on a LANE, from its VTYPE and speed factor."""
    limit = min(lane["speed_mps"], kind["desired_max_speed"])
    return float(min(limit * speed_factor, kind["max_speed"]))


@kernel
def route_time_s(roads: RoadArrays, travel: TripTables, row: np.void, begin_s: float) -> float:
    """Return the time in s after which a trip counts as too long.

    The result is the travel time at the speed limits times `TripTables.trip_horizon`, plus one
    signal cycle per signal on the route, of the program that is active at `begin_s`.
    """
    lane, way = row["lane"], row["way"]
    free_s = -row["s"] / roads.lanes[lane]["speed_mps"]
    signals_s = 0.0
    for _ in range(roads.lanes.shape[0]):
        free_s += roads.lanes[lane]["length_m"] / roads.lanes[lane]["speed_mps"]
        lane, way, link = next_step_of_plan(roads, travel, lane, way)
        if lane < 0:
            break
        if link >= 0 and roads.links[link]["signal"] >= 0:
            program = program_at(roads, roads.links[link]["signal"], begin_s, travel.tick_s)
            signals_s += roads.programs[program]["cycle_s"]
    return float(travel.trip_horizon * free_s + signals_s)
