"""Tracking: the lane of a freely steered vehicle, and its position on that lane.

The vehicle's lane, its neighbours and the next lanes are checked first. If the vehicle is on none
of them, all lanes near its place are searched: it may have crossed to another road, be on the wrong
side, or be off the road.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import cos_sin, cosine, sine
from cavmarl.core.math.geometry import lane_pose, project, project_near
from cavmarl.core.records.arrays import LaneGrid, RoadArrays
from cavmarl.core.records.codes import EVENT_OFF_ROAD, EVENT_WRONG_WAY
from cavmarl.driving.kernels.lanes.lane_index import beside_s, goes_on_m

JUNCTION_MARGIN_M = 2.0  # inside junctions, the road extends this far beyond the sides of a lane
END_MARGIN_M = 1.0  # gaps up to this size between the end and the start of lanes are road
SEAM_M = 1.0  # gaps up to this size between adjacent lanes, in bends, are road
WINDOW_M = 40.0
TURNING_M = 6.0  # slightly more than the radius of a car's turning circle
SIDE_MARGIN_M = 0.1  # a body this close to a neighbour lane covers it, as it may be at an angle
LEVEL_M = 4.0  # lanes more than this above or below belong to another road


@kernel
def side_lane(roads: RoadArrays, row: np.void) -> int:
    """Return the neighbour lane that a vehicle's body also covers, or -1.

    Where the neighbour of the previous lane continues beside the junction, the result is that
    neighbour until the rear has passed its end.
    """
    lane = roads.lanes[row["lane"]]
    d = row["d"]
    free = 0.5 * (lane["width_m"] - row["width"]) - SIDE_MARGIN_M
    if -free <= d <= free:
        return -1
    to_left = d > free
    if lane["internal"] and to_left == (d > 0.0):
        before = roads.links[lane["link"]]["from_lane"]
        beside = roads.lanes[before]["left"] if to_left else roads.lanes[before]["right"]
        if beside >= 0 and goes_on_m(roads, before, beside) > 0.0:
            rear = beside_s(roads, row["lane"], beside, row["s"]) - 0.5 * row["length"]
            if rear < roads.lanes[beside]["length_m"]:
                return int(beside)
    return int(lane["left"] if to_left else lane["right"])


@kernel
def _on(
    roads: RoadArrays, lane: int, x: float, y: float, hint: float
) -> tuple[float, float, float]:
    """Return s and d of a point on `lane`, and how far it is outside; `hint`: approximate s, m."""
    row = roads.lanes[lane]
    s, d, _, _ = project_near(
        roads.points, row["first_point"], row["num_points"], x, y, hint, WINDOW_M
    )
    half = 0.5 * row["width_m"]
    if row["internal"]:
        half += JUNCTION_MARGIN_M
    beyond = max(s - row["length_m"], -s)
    return s, d, max(abs(d) - half, beyond - END_MARGIN_M)


@kernel
def _follow(roads: RoadArrays, plans: NDArray[np.void], row: np.void) -> None:
    """Move a vehicle that has passed its lane's end to the next lanes.

    Choose the planned lane unless the vehicle is closer to the middle of another lane.
    """
    for _ in range(4):
        lane = roads.lanes[row["lane"]]
        if row["s"] < lane["length_m"]:
            return
        rest = row["s"] - lane["length_m"]
        planned = plans[row["goal"], row["lane"]]["next"]
        best = -1
        best_link = -1
        best_off = math.inf
        best_s = 0.0
        best_d = 0.0
        if lane["internal"]:
            best = lane["successor"]
            best_s, best_d, _ = _on(roads, best, row["x"], row["y"], rest)
        else:
            for link in range(lane["first_link"], lane["first_link"] + lane["num_links"]):
                candidate = roads.links[link]["next_lane"]
                s, d, _ = _on(roads, candidate, row["x"], row["y"], rest)
                off = abs(d) if candidate != planned else min(abs(d), 1.0) - 1.0
                if off < best_off:
                    best = candidate
                    best_link = link
                    best_off = off
                    best_s = s
                    best_d = d
        if best < 0:
            return
        row["lane"] = best
        row["s"] = max(best_s, 0.0)
        row["d"] = best_d
        if best_link >= 0:
            row["link"] = best_link


@kernel
def _search(roads: RoadArrays, grid: LaneGrid, row: np.void) -> int:
    """Find the lane of a vehicle that has left its own lane, and return EVENT_* bits."""
    column = int((row["x"] - grid.min_x) // grid.cell_m)
    line = int((row["y"] - grid.min_y) // grid.cell_m)
    if column < 0 or line < 0 or column >= grid.num_x or line >= grid.num_y:
        return EVENT_OFF_ROAD
    cell = line * grid.num_x + column
    best = -1
    best_rank = math.inf
    best_s = 0.0
    best_d = 0.0
    cos_heading, sin_heading = cos_sin(row["heading"])
    for k in range(grid.cell_start[cell], grid.cell_start[cell + 1]):
        lane = grid.cell_lanes[k]
        here = roads.lanes[lane]
        s, d, cos, sin = project(
            roads.points, here["first_point"], here["num_points"], row["x"], row["y"]
        )
        half = 0.5 * here["width_m"] + (JUNCTION_MARGIN_M if here["internal"] else 0.0)
        if abs(d) > half or s < 0.0 or s > here["length_m"]:
            continue
        if abs(roads.points[here["first_point"]]["z"] - row["z"]) > LEVEL_M:
            continue
        # Prefer lanes in the vehicle's direction, then the lane whose middle is nearest.
        rank = abs(d) + (0.0 if cos * cos_heading + sin * sin_heading > 0.0 else 100.0)
        if rank < best_rank:
            best = lane
            best_rank = rank
            best_s = s
            best_d = d
    if best < 0:
        return EVENT_OFF_ROAD
    if best_rank >= 100.0:
        return EVENT_WRONG_WAY
    row["lane"] = best
    row["s"] = best_s
    row["d"] = best_d
    return 0


@inlined_kernel
def _set_distance_beyond(roads: RoadArrays, row: np.void) -> None:
    """Set d to the distance beyond the start or the end of the lane if that is larger."""
    beyond = max(row["s"] - roads.lanes[row["lane"]]["length_m"], -row["s"])
    if beyond > abs(row["d"]):
        row["d"] = math.copysign(beyond, row["d"])


@kernel
def locate(
    roads: RoadArrays,
    plans: NDArray[np.void],  # PLAN (goals, lanes)
    grid: LaneGrid,  # the lanes near each place
    row: np.void,  # VEHICLE with the new x, y and heading and the old lane; updated
) -> int:
    """Update lane, s, d and link of a steered vehicle for its new position.

    A vehicle that is on no lane of its direction keeps its last lane. Then s is limited to that
    lane, and if the distance beyond the lane's start or end is larger than d, it replaces d.

    Returns:
        The bits EVENT_OFF_ROAD and EVENT_WRONG_WAY; 0: neither.
    """
    lane = row["lane"]
    s, d, outside = _on(roads, lane, row["x"], row["y"], row["s"])
    row["s"] = s
    row["d"] = d
    if s >= roads.lanes[lane]["length_m"]:
        _follow(roads, plans, row)
        _, _, outside = _on(roads, row["lane"], row["x"], row["y"], row["s"])
    half = 0.5 * roads.lanes[row["lane"]]["width_m"]
    beside = -1
    if row["d"] > half:
        beside = roads.lanes[row["lane"]]["left"]
    elif row["d"] < -half:
        beside = roads.lanes[row["lane"]]["right"]
    if beside >= 0:
        s, d, off = _on(roads, beside, row["x"], row["y"], row["s"])
        between = row["d"] * d < 0.0
        apart = abs(row["d"]) + abs(d) - half - 0.5 * roads.lanes[beside]["width_m"]
        if abs(d) < abs(row["d"]):
            row["lane"] = beside
            row["s"] = s
            row["d"] = d
            outside = off
        if outside > 0.0 and between and apart <= SEAM_M:
            length = roads.lanes[row["lane"]]["length_m"]
            outside = max(row["s"] - length, -row["s"]) - END_MARGIN_M
    events = 0
    if outside > 0.0:
        events |= _search(roads, grid, row)
        if events:
            _set_distance_beyond(roads, row)
    here = roads.lanes[row["lane"]]
    row["s"] = min(max(row["s"], 0.0), here["length_m"])
    if not _drives_along(roads, row):
        events |= EVENT_WRONG_WAY
    return events


@kernel
def _drives_along(roads: RoadArrays, row: np.void) -> bool:
    """Return whether the vehicle heads within 90° of its lane's direction, here or close by.

    Lanes may turn more sharply than a car can, so a car may turn earlier or later than its lane.
    Inside a junction, the directions of the incoming and the outgoing road count as well.
    """
    lane = roads.lanes[row["lane"]]
    if _heads_along(roads, row, lane, row["s"]):
        return True
    if not lane["internal"]:
        behind = _heads_along(roads, row, lane, max(row["s"] - TURNING_M, 0.0))
        return behind or _heads_along(roads, row, lane, row["s"] + TURNING_M)
    link = roads.links[lane["link"]]
    before = roads.lanes[link["from_lane"]]
    along: bool = _heads_along(roads, row, before, before["length_m"])
    return along or _heads_along(roads, row, roads.lanes[link["to_lane"]], 0.0)


@kernel
def _heads_along(roads: RoadArrays, row: np.void, lane: np.void, s: float) -> bool:
    """Return whether the vehicle heads within 90° of the direction of a lane at `s`."""
    _, _, _, cos, sin, _ = lane_pose(roads.points, lane["first_point"], lane["num_points"], s)
    along: bool = cosine(row["heading"]) * cos + sine(row["heading"]) * sin >= 0.0
    return along
