"""Leaders on adjacent lanes.

They are on a lane that the vehicle also covers or will cover, or they reach into its lane.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import cosine, sine
from cavmarl.core.math.geometry import lane_pose
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import DRIVER_SCRIPTED
from cavmarl.core.records.rows import is_steered
from cavmarl.driving.kernels.junctions.swept_areas import BUS_M
from cavmarl.driving.kernels.lanes.lane_index import ahead_on, beside_s, last_on
from cavmarl.driving.kernels.models.following import behind, no_constraint
from cavmarl.roads.kernels.plans import TURNAROUND

STICKS_OUT_M = 0.1  # a vehicle this far beyond the side of its lane sticks out
ASKEW_RAD = 0.15  # with a smaller angle to its lane, a vehicle does not stick out
SWINGS_BACK_M = 3.0  # how far the rear of a 12 m bus moves back during a U-turn on its path


@inlined_kernel
def behind_entry(kind: np.void, speed: float, gap: float, leader: np.void) -> float:
    """Return the constraint that a leader (ENTRY) imposes; larger is stricter.

    The module `car_following_model` explains constraints. `gap` is between the bumpers in m.
    """
    return behind(kind, speed, gap, leader["speed"], leader["decel"])


@inlined_kernel
def rear_swing_m(
    roads: RoadArrays, travel: TripTables, rows: NDArray[np.void], leader: np.void
) -> float:
    """Return how far a leader's rear may move back, in m, as the rear of a bus does in a U-turn."""
    if leader["half"] <= 0.5 * BUS_M:
        return 0.0
    other = rows[leader["row"]]
    if other["driver"] == DRIVER_SCRIPTED:
        return 0.0
    here = roads.lanes[other["lane"]]
    link = here["link"] if here["internal"] else travel.steps[other["way"] + other["lane"]]["link"]
    turns: bool = link >= 0 and roads.links[link]["direction"] == TURNAROUND
    return SWINGS_BACK_M if turns else 0.0


@kernel
def behind_adjacent_leader(
    roads: RoadArrays, travel: TripTables, kind: np.void, row: np.void, lane: int, scratch: Scratch
) -> float:
    """Return the constraint of the leader on a lane that the body also covers or will cover."""
    target = roads.lanes[lane]
    s = beside_s(roads, row["lane"], lane, row["s"])
    half = 0.5 * row["length"]
    j = ahead_on(scratch, lane, s, row["id"], travel.view_m)
    if j >= 0:
        leader = scratch.entries[j]
        return behind_entry(kind, row["speed"], leader["s"] - s - half - leader["half"], leader)
    # Search beyond the end of that lane, on all links that leave it.
    constraint = no_constraint(kind)
    for link in range(target["first_link"], target["first_link"] + target["num_links"]):
        distance = target["length_m"] - s
        beyond = roads.links[link]["next_lane"]
        j = last_on(scratch, beyond, row["id"], distance, travel.view_m)
        while j < 0 and roads.lanes[beyond]["internal"]:
            distance += roads.lanes[beyond]["length_m"]
            beyond = roads.lanes[beyond]["successor"]
            j = last_on(scratch, beyond, row["id"], distance, travel.view_m)
        if j >= 0:
            leader = scratch.entries[j]
            gap = distance + leader["s"] - half - leader["half"]
            constraint = max(constraint, behind_entry(kind, row["speed"], gap, leader))
    return constraint


@kernel
def _sticks_out(roads: RoadArrays, other: np.void, to_left: bool) -> bool:
    """Return whether a corner of a vehicle that is askew reaches over a side of its lane."""
    here = roads.lanes[other["lane"]]
    _, _, _, cos, sin, _ = lane_pose(
        roads.points, here["first_point"], here["num_points"], other["s"]
    )
    across = sine(other["heading"]) * cos - cosine(other["heading"]) * sin
    if abs(across) < ASKEW_RAD:
        return False
    along = math.sqrt(max(1.0 - across * across, 0.0))
    reach = 0.5 * (other["length"] * abs(across) + other["width"] * along)
    aside = other["d"] if to_left else -other["d"]
    out: bool = aside + reach > 0.5 * here["width_m"] + STICKS_OUT_M
    return out


@kernel
def next_askew(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,)
    lane: int,
    s: float,
    own_id: int,
    to_left: bool,  # search the left neighbour lane, else the right neighbour lane
    scratch: Scratch,
) -> tuple[int, float]:
    """Find the next steered vehicle ahead of `s` that sticks out from a neighbour lane.

    Returns:
        The vehicle's entry and the distance of its centre in m, or (-1, inf).
    """
    here = roads.lanes[lane]
    neighbor = here["left"] if to_left else here["right"]
    if neighbor < 0:
        return -1, math.inf
    place = beside_s(roads, lane, neighbor, s)
    k = ahead_on(scratch, neighbor, place, own_id, travel.view_m)
    while 0 <= k < scratch.lane_end[neighbor]:
        entry = scratch.entries[k]
        if entry["s"] - place > travel.view_m:
            break
        other = rows[entry["row"]]
        passed_over = entry["side"] or entry["id"] == own_id or not is_steered(other)
        if not passed_over and _sticks_out(roads, other, not to_left):
            return k, entry["s"] - place
        k += 1
    return -1, math.inf


@kernel
def behind_askew(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,)
    kind: np.void,
    row: np.void,  # VEHICLE of an agent
    lane: int,  # the vehicle's lane, or a lane ahead
    s: float,  # position of the vehicle on that lane, negative before its start, m
    scratch: Scratch,
) -> float:
    """Return the constraint of steered vehicles ahead that stick out from neighbour lanes."""
    constraint = no_constraint(kind)
    begin = max(s, 0.0)
    for to_left in (True, False):
        k, apart = next_askew(roads, travel, rows, lane, begin, row["id"], to_left, scratch)
        apart += begin - s
        if k >= 0 and apart <= travel.view_m:
            leader = scratch.entries[k]
            gap = apart - 0.5 * row["length"] - leader["half"]
            constraint = max(constraint, behind_entry(kind, row["speed"], gap, leader))
    return constraint
