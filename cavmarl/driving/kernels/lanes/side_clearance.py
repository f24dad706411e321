"""Side clearance: whether a vehicle that changes lanes would touch stopped vehicles beside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import cosine, sine
from cavmarl.core.math.geometry import boxes_overlap, lane_pose
from cavmarl.core.records.arrays import RoadArrays, Scratch
from cavmarl.driving.kernels.junctions.stop_line_registration import STANDING_MPS
from cavmarl.driving.kernels.lanes.lane_index import beside_s

LONGEST_HALF_M = 10.0  # half the length of the longest vehicle
STAYS_ASIDE = 2  # value of `lane_change`: wait between two lanes
MARGIN_M = 0.1  # required clearance on each side of the ego body
ASIDE_MPS = 5.0  # up to this speed, a vehicle between two lanes checks its side clearance


@kernel
def has_side_clearance(
    roads: RoadArrays,
    rows: NDArray[np.void],  # VEHICLE (C,)
    row: np.void,  # VEHICLE that moves, or would move, to the middle of a lane
    target: int,  # LANE to whose middle it moves
    s: float,  # position of the vehicle's centre on that lane, m
    d: float,  # offset of the centre from the middle of that lane, m, positive to the left
    side: int,  # direction of the move: 1 left, -1 right
    scratch: Scratch,
) -> bool:
    """Return whether a vehicle touches no stopped vehicle on the side to which it moves.

    The check covers vehicles on the lane, on the adjacent lanes, and right before or behind these
    lanes.
    """
    lane = roads.lanes[target]
    x, y, _, cos, sin, _ = lane_pose(roads.points, lane["first_point"], lane["num_points"], s)
    pose = x - d * sin, y + d * cos, cos, sin, float(side)
    reach = 0.5 * row["length"] + LONGEST_HALF_M
    edge = roads.edges[lane["edge"]]
    first, end = edge["first_lane"], edge["first_lane"] + edge["num_lanes"]
    for lane_beside in range(max(target - 1, first), min(target + 2, end)):
        here = roads.lanes[lane_beside]
        place = beside_s(roads, target, lane_beside, s)
        if _is_touched(rows, row, pose, lane_beside, place, reach, scratch):
            return False
        for k in range(here["num_into"]):
            before = roads.into[here["first_into"] + k]
            over = roads.lanes[before]["length_m"] + place
            if place < reach and _is_touched(rows, row, pose, before, over, reach, scratch):
                return False
        to_end = here["length_m"] - place
        for link in range(here["first_link"], here["first_link"] + here["num_links"]):
            beyond = roads.links[link]["next_lane"]
            if to_end < reach and _is_touched(rows, row, pose, beyond, -to_end, reach, scratch):
                return False
    return True


@kernel
def _is_touched(
    rows: NDArray[np.void],
    row: np.void,
    pose: tuple[float, float, float, float, float],  # x, y, cosine, sine, side
    lane: int,
    place: float,
    reach: float,
    scratch: Scratch,
) -> bool:
    """Return whether a body at a pose touches a stopped vehicle near a position of a lane."""
    x, y, cos, sin, side = pose
    half, half_width = 0.5 * row["length"] + MARGIN_M, 0.5 * row["width"] + MARGIN_M
    for k in range(scratch.lane_start[lane], scratch.lane_end[lane]):
        entry = scratch.entries[k]
        if abs(entry["s"] - place) > reach or entry["speed"] > STANDING_MPS:
            continue
        other = rows[entry["row"]]
        aside = (other["y"] - y) * cos - (other["x"] - x) * sin
        if other["id"] == row["id"] or aside * side <= 0.0:
            continue
        if boxes_overlap(
            x, y, cos, sin, half, half_width,
            other["x"], other["y"], cosine(other["heading"]), sine(other["heading"]),
            0.5 * other["length"], 0.5 * other["width"],
        ):  # fmt: skip
            return True
    return False


@inlined_kernel
def has_to_stay_aside(
    roads: RoadArrays, rows: NDArray[np.void], row: np.void, scratch: Scratch
) -> bool:
    """Return whether a vehicle between two lanes must stay there to avoid a stopped vehicle."""
    if row["d"] == 0.0 or row["speed"] > ASIDE_MPS:
        return False
    side = -1 if row["d"] > 0.0 else 1
    d = row["d"] + side * min(abs(row["d"]), MARGIN_M)
    return not has_side_clearance(roads, rows, row, row["lane"], row["s"], d, side, scratch)
