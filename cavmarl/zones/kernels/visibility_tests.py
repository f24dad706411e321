"""The parts of lanes with vehicles that a zone's drivers may consider.

A halo is as wide as the farthest look in any direction. But a driver only considers vehicles along
its route, beside it, and on the approach to the stop lines before it. Most lanes within the halo
have no such vehicles. This module follows the roads from the zone's own lanes, and finds the part
of each lane in which vehicles can matter. A part that is too large causes needless copies; a part
that is too small causes wrong results.

The search runs once per partition, not in each tick.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.rows import ENTER_REACH_M, MERGES_M, STEERED, SWEPT_BEYOND_M
from cavmarl.driving.kernels.junctions.deadlocks import on_equal_road
from cavmarl.driving.kernels.junctions.gaps import STATE_MAJOR
from cavmarl.driving.kernels.junctions.junctions import EXIT_LOOK_M
from cavmarl.driving.kernels.junctions.stop_line_registration import APPROACH_M
from cavmarl.driving.kernels.junctions.swept_areas import size_of
from cavmarl.driving.kernels.lanes.lane_choice import LOOK_BACK_M
from cavmarl.driving.kernels.lanes.lane_index import goes_on_m
from cavmarl.zones.kernels.lane_paths import begin_paths, extend_paths
from cavmarl.zones.kernels.visibility_scratch import VisibilityScratch
from cavmarl.zones.kernels.zone_lookup import squared_distance

AT_LINE_M = 0.2  # a vehicle within this distance of a line may be about to cross it
ASIDE_M = 10.0  # places side by side on an edge differ by at most this, in the plane and in `s`
BACK_M = max(LOOK_BACK_M, ENTER_REACH_M)  # followers' lanes end at most this far behind a zone
ROUNDING_M = 0.1  # limit of rounding errors of sums over lanes and of float32


@kernel
def _within(
    rect: NDArray[np.float64], x: float, y: float, to_x: float, to_y: float
) -> tuple[float, float]:
    """Return the part of a segment in a rectangle, as shares from 0 to 1; none: (inf, -inf)."""
    low = 0.0
    high = 1.0
    for axis in range(2):
        start = x if axis == 0 else y
        way = to_x - x if axis == 0 else to_y - y
        near = rect[axis] - start
        far = rect[axis + 2] - start
        if way == 0.0:
            if near > 0.0 or far < 0.0:
                return math.inf, -math.inf
            continue
        low = max(low, min(near / way, far / way))
        high = min(high, max(near / way, far / way))
    if low > high:
        return math.inf, -math.inf
    return low, high


@kernel
def _find_own(roads: RoadArrays, rect: NDArray[np.float64], scratch: VisibilityScratch) -> None:
    """Find the part of each lane in a rectangle, the same for all lanes of an edge."""
    for lane in range(roads.lanes.shape[0]):
        scratch.first[lane] = math.inf
        scratch.last[lane] = -math.inf
        begin = roads.lanes[lane]["first_point"]
        for k in range(begin, begin + roads.lanes[lane]["num_points"] - 1):
            point = roads.points[k]
            after = roads.points[k + 1]
            low, high = _within(rect, point["x"], point["y"], after["x"], after["y"])
            if low <= high:
                long = after["s"] - point["s"]
                scratch.first[lane] = min(scratch.first[lane], point["s"] + low * long)
                scratch.last[lane] = max(scratch.last[lane], point["s"] + high * long)
    for edge in range(roads.edges.shape[0]):
        begin = roads.edges[edge]["first_lane"]
        end = begin + roads.edges[edge]["num_lanes"]
        first = math.inf
        last = -math.inf
        for lane in range(begin, end):
            first = min(first, scratch.first[lane])
            last = max(last, scratch.last[lane])
        if first > last:
            continue
        for lane in range(begin, end):
            length = roads.lanes[lane]["length_m"]
            scratch.first[lane] = min(max(first - ASIDE_M, 0.0), length)
            scratch.last[lane] = min(last + ASIDE_M, length)


@inlined_kernel
def _widen(looks: NDArray[np.void], lane: int, first: float, last: float, length: float) -> None:
    """Extend the visible part of a lane by the part between two places."""
    if first > last or last < 0.0 or first > length:
        return
    if first <= 0.0:
        looks[lane]["head"] = max(looks[lane]["head"], last + ROUNDING_M)
    elif last >= length:
        looks[lane]["tail"] = min(looks[lane]["tail"], first - ROUNDING_M)
    else:
        looks[lane]["head"] = math.inf


@inlined_kernel
def _longest_beside_m(roads: RoadArrays, lane: int) -> float:
    """Return how many m adjacent lanes go on beside the junction at a lane's end; 0: none do."""
    further = 0.0
    for side in (roads.lanes[lane]["left"], roads.lanes[lane]["right"]):
        if side >= 0 and not roads.lanes[lane]["internal"]:
            further = max(further, goes_on_m(roads, lane, side))
    return further


@kernel
def _look_beyond(
    roads: RoadArrays, lane: int, back: float, half_m: float, looks: NDArray[np.void]
) -> None:
    """Make vehicles visible that are past a lane's end but may cover a longer adjacent lane.

    Followers are visible beyond the place `back` in m on the lane; inf: all vehicles are visible.
    """
    further = _longest_beside_m(roads, lane)
    if further == 0.0:
        return
    for link in range(
        roads.lanes[lane]["first_link"],
        roads.lanes[lane]["first_link"] + roads.lanes[lane]["num_links"],
    ):
        inside = roads.links[link]["next_lane"]
        rest = further + half_m + ROUNDING_M
        while roads.lanes[inside]["internal"] and rest > 0.0:
            if back == math.inf:
                _widen(looks, inside, 0.0, rest, roads.lanes[inside]["length_m"])
            else:
                place = back - roads.lanes[lane]["length_m"] - roads.lanes[inside]["link_offset_m"]
                looks[inside]["back"] = min(looks[inside]["back"], place)
            rest -= roads.lanes[inside]["length_m"]
            inside = roads.lanes[inside]["successor"]


@kernel
def _see(
    roads: RoadArrays,
    lane: int,
    first: float,
    last: float,
    half_m: float,  # half the length of the longest vehicle
    looks: NDArray[np.void],
) -> None:
    """Extend the visible part of all lanes of an edge: adjacent vehicles may change lanes."""
    edge = roads.edges[roads.lanes[lane]["edge"]]
    for other in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
        length = roads.lanes[other]["length_m"]
        _widen(looks, other, first, last, length)
        if edge["num_lanes"] > 1 and first <= last and last + ASIDE_M >= length:
            _look_beyond(roads, other, math.inf, half_m, looks)


@kernel
def _look_along(
    roads: RoadArrays,
    view_m: float,
    see_m: float,
    half_m: float,
    scratch: VisibilityScratch,
    looks: NDArray[np.void],
) -> None:
    """Make leaders and followers of the zone's vehicles visible."""
    view_m = max(view_m, see_m, LOOK_BACK_M)
    for lane in range(roads.lanes.shape[0]):
        scratch.ahead[lane] = math.inf
        scratch.behind[lane] = math.inf
    for lane in range(roads.lanes.shape[0]):
        if scratch.first[lane] <= scratch.last[lane]:
            left = roads.lanes[lane]["length_m"] - scratch.last[lane]
            begin_paths(roads, lane, True, left, scratch.ahead)
            begin_paths(roads, lane, False, scratch.first[lane], scratch.behind)
            first, last = scratch.first[lane] - view_m, scratch.last[lane] + view_m
            _see(roads, lane, first, last, half_m, looks)
    extend_paths(roads, True, view_m, scratch.ahead, scratch)
    for lane in range(roads.lanes.shape[0]):
        if scratch.ahead[lane] <= view_m:
            _see(roads, lane, 0.0, view_m - scratch.ahead[lane], half_m, looks)
    extend_paths(roads, False, BACK_M, scratch.behind, scratch)
    for lane in range(roads.lanes.shape[0]):
        if scratch.behind[lane] <= BACK_M:
            back = scratch.behind[lane] + roads.lanes[lane]["length_m"] - ROUNDING_M
            edge = roads.edges[roads.lanes[lane]["edge"]]
            for other in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
                place = back if other == lane else back - ASIDE_M
                looks[other]["back"] = min(looks[other]["back"], place)
                _look_beyond(roads, other, place, half_m, looks)


@kernel
def _find_lines(roads: RoadArrays, see_m: float, half_m: float, scratch: VisibilityScratch) -> None:
    """Find the links that the zone's drivers may want to enter, and the foes of these links."""
    largest = size_of(half_m)
    for link in range(roads.links.shape[0]):
        scratch.asked[link] = False
        scratch.foe[link] = False
        scratch.swept[link] = False
    for lane in range(roads.lanes.shape[0]):
        row = roads.lanes[lane]
        own = scratch.first[lane] <= scratch.last[lane]
        if row["internal"]:
            if own:
                _mark_links_after(roads, roads.links[row["link"]]["from_lane"], scratch)
        elif (own and row["length_m"] - scratch.last[lane] <= see_m) or (
            scratch.ahead[lane] + row["length_m"] <= see_m
        ):
            _mark_links_after(roads, lane, scratch)
        if own and not row["internal"] and scratch.first[lane] <= SWEPT_BEYOND_M + half_m:
            _mark_links_beside(roads, lane, scratch)
    for link in range(roads.links.shape[0]):
        if scratch.asked[link]:
            first = roads.links[link]["first_conflict"]
            for c in range(first, first + roads.links[link]["num_conflicts"]):
                scratch.foe[roads.conflicts[c]["foe"]] = True
            first = roads.links[link]["first_sweep"]
            for k in range(first, first + roads.links[link]["num_sweeps"]):
                sweep = roads.sweeps[k]
                known = sweep["own"] <= largest or sweep["own"] == STEERED
                if known and (sweep["other"] <= largest or sweep["other"] == STEERED):
                    scratch.foe[sweep["foe"]] = True
                    scratch.swept[sweep["foe"]] = True
    grown = True
    while grown:  # on equal roads, drivers search for cycles of vehicles that must yield
        grown = False
        for link in range(roads.links.shape[0]):
            if not (scratch.foe[link] and on_equal_road(roads, link)):
                continue
            first = roads.links[link]["first_conflict"]
            for c in range(first, first + roads.links[link]["num_conflicts"]):
                foe = roads.conflicts[c]["foe"]
                if roads.conflicts[c]["must_yield"] and not scratch.foe[foe]:
                    scratch.foe[foe] = True
                    grown = True


@kernel
def _mark_links_after(roads: RoadArrays, lane: int, scratch: VisibilityScratch) -> None:
    """Mark all links that begin at the edge of a lane."""
    edge = roads.edges[roads.lanes[lane]["edge"]]
    for other in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
        first = roads.lanes[other]["first_link"]
        for link in range(first, first + roads.lanes[other]["num_links"]):
            scratch.asked[link] = True


@kernel
def _mark_links_beside(roads: RoadArrays, lane: int, scratch: VisibilityScratch) -> None:
    """Mark links whose vehicles may obstruct the start of a lane."""
    for k in range(roads.lanes[lane]["num_into"]):
        before = roads.lanes[roads.into[roads.lanes[lane]["first_into"] + k]]
        if before["internal"]:
            _mark_links_after(roads, roads.links[before["link"]]["from_lane"], scratch)


@kernel
def _look_at_junctions(
    roads: RoadArrays, half_m: float, scratch: VisibilityScratch, looks: NDArray[np.void]
) -> None:
    """Make vehicles visible that approach the lines of foes, are on a junction, or are after it."""
    for lane in range(roads.lanes.shape[0]):
        scratch.to_line[lane] = math.inf
        scratch.to_room[lane] = math.inf
        scratch.beyond[lane] = math.inf
    for link in range(roads.links.shape[0]):
        if not (scratch.asked[link] or scratch.foe[link]):
            continue
        row = roads.links[link]
        lane = row["next_lane"]
        while roads.lanes[lane]["internal"]:
            _see(roads, lane, 0.0, roads.lanes[lane]["length_m"], half_m, looks)
            lane = roads.lanes[lane]["successor"]
        _see(roads, lane, 0.0, SWEPT_BEYOND_M + half_m, half_m, looks)
        if scratch.asked[link] and row["num_conflicts"] > 0:
            scratch.beyond[lane] = 0.0
        if scratch.foe[link]:
            edge = roads.edges[roads.lanes[row["from_lane"]]["edge"]]
            for other in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
                scratch.to_line[other] = 0.0
                if scratch.swept[link]:
                    scratch.to_room[other] = 0.0
    extend_paths(roads, False, APPROACH_M, scratch.to_line, scratch)
    extend_paths(roads, False, APPROACH_M, scratch.to_room, scratch)
    extend_paths(roads, True, EXIT_LOOK_M, scratch.beyond, scratch)
    for lane in range(roads.lanes.shape[0]):
        if scratch.beyond[lane] <= EXIT_LOOK_M:
            _see(roads, lane, 0.0, EXIT_LOOK_M - scratch.beyond[lane], half_m, looks)
        if scratch.to_line[lane] <= APPROACH_M:
            edge = roads.edges[roads.lanes[lane]["edge"]]
            for other in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
                line = scratch.to_line[lane] + roads.lanes[other]["length_m"]
                looks[other]["line"] = min(looks[other]["line"], line - ROUNDING_M)
                room = scratch.to_room[lane] + roads.lanes[other]["length_m"]
                looks[other]["room"] = min(looks[other]["room"], room - ROUNDING_M)


@inlined_kernel
def _merge_from(roads: RoadArrays, lane: int, way: float, looks: NDArray[np.void]) -> None:
    """Make vehicles on a lane's edge visible within `MERGES_M` of the line `way` m ahead."""
    edge = roads.edges[roads.lanes[lane]["edge"]]
    for other in range(edge["first_lane"], edge["first_lane"] + edge["num_lanes"]):
        place = way + roads.lanes[other]["length_m"] - ROUNDING_M
        looks[other]["merge"] = min(looks[other]["merge"], place)


@kernel
def _look_at_merges(roads: RoadArrays, scratch: VisibilityScratch, looks: NDArray[np.void]) -> None:
    """Make vehicles visible at greater distances before the lines of foes where vehicles merge.

    These vehicles are on the lanes before the lines, or on lanes with the right of way that lead to
    these lanes.
    """
    for lane in range(roads.lanes.shape[0]):
        if scratch.to_line[lane] == 0.0 and roads.lanes[lane]["merges"]:
            place = roads.lanes[lane]["length_m"] - ROUNDING_M
            looks[lane]["merge"] = min(looks[lane]["merge"], place)
    for link in range(roads.links.shape[0]):
        row = roads.links[link]
        beyond = roads.lanes[row["to_lane"]]
        way = beyond["length_m"]
        if scratch.to_line[row["to_lane"]] > 0.0 or not beyond["merges"] or way > MERGES_M:
            continue
        inside = row["next_lane"]
        while roads.lanes[inside]["internal"]:
            way += roads.lanes[inside]["length_m"]
            inside = roads.lanes[inside]["successor"]
        inside = row["next_lane"]
        while roads.lanes[inside]["internal"]:
            place = way - roads.lanes[inside]["link_offset_m"] - ROUNDING_M
            looks[inside]["merge"] = min(looks[inside]["merge"], place)
            inside = roads.lanes[inside]["successor"]
        if row["state"] == STATE_MAJOR:
            _merge_from(roads, row["from_lane"], way, looks)


@kernel
def find_looks(
    roads: RoadArrays,
    # (4,) min_x, min_y, max_x, max_y in m: the area of the zone's drivers and departures
    rect: NDArray[np.float64],
    view_m: float,  # how far any driver looks along the road
    see_m: float,  # distance of a driver's centre to a line at which it considers the junction
    half_m: float,  # half the length of the longest vehicle
    scratch: VisibilityScratch,  # see `make_scratch`
    looks: NDArray[np.void],  # LOOK (L,) output
) -> None:
    """Find the part of each lane in which vehicles matter to the drivers of one zone."""
    for lane in range(roads.lanes.shape[0]):
        looks[lane]["head"] = -math.inf
        looks[lane]["tail"] = math.inf
        looks[lane]["back"] = math.inf
        looks[lane]["line"] = math.inf
        looks[lane]["room"] = math.inf
        looks[lane]["merge"] = math.inf
    _find_own(roads, rect, scratch)
    _look_along(roads, view_m, see_m, half_m, scratch, looks)
    _find_lines(roads, see_m, half_m, scratch)
    _look_at_junctions(roads, half_m, scratch, looks)
    _look_at_merges(roads, scratch, looks)


@kernel
def _farther(
    near: np.void,
    far: np.void,
    first: float,
    last: float,
    rects: NDArray[np.float64],
    zone: int,
    squared: float,
) -> float:
    """Return the maximum of `squared` and the squared distance from a zone to part of a segment.

    The part is from `first` to `last` m of the lane. One of its ends is its farthest point.
    """
    first = max(first, near["s"])
    last = min(last, far["s"])
    if first > last:
        return squared
    long = far["s"] - near["s"]
    for s in (first, last):
        share = (s - near["s"]) / long if long > 0.0 else 0.0
        x = near["x"] + share * (far["x"] - near["x"])
        y = near["y"] + share * (far["y"] - near["y"])
        squared = max(squared, squared_distance(rects, zone, x, y))
    return squared


@kernel
def farthest_m(
    roads: RoadArrays,
    rects: NDArray[np.float64],  # (k, 4) all zones, as in `ZoneArrays`
    zone: int,
    looks: NDArray[np.void],  # LOOK (L,) of the zone, from `find_looks`
) -> float:
    """Return the distance from a zone to the farthest vehicle that its drivers may consider."""
    squared = 0.0
    for lane in range(roads.lanes.shape[0]):
        look = looks[lane]
        first = roads.lanes[lane]["first_point"]
        for k in range(first, first + roads.lanes[lane]["num_points"] - 1):
            near = roads.points[k]
            far = roads.points[k + 1]
            squared = _farther(near, far, -math.inf, look["head"], rects, zone, squared)
            squared = _farther(near, far, look["tail"], math.inf, rects, zone, squared)
            announced = min(look["back"], look["line"]) - APPROACH_M
            announced = min(announced, look["merge"] - MERGES_M)
            squared = _farther(near, far, announced, math.inf, rects, zone, squared)
    return math.sqrt(squared)
