"""A plain version of `find_looks`: the lanes at which drivers of a zone may look, as sets."""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.rows import (
    ENTER_REACH_M,
    MERGES_M,
    SIZE_LENGTHS_M,
    STEERED,
    SWEPT_BEYOND_M,
)
from cavmarl.driving.kernels.junctions.junctions import EXIT_LOOK_M
from cavmarl.driving.kernels.junctions.stop_line_registration import APPROACH_M
from cavmarl.driving.kernels.lanes.lane_choice import LOOK_BACK_M
from cavmarl.driving.kernels.lanes.lane_index import GOES_ON_M
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.kernels.visibility_tests import ASIDE_M, ROUNDING_M
from tests.naive.lanes import beside_s

__all__ = ["Looks"]

Ways = dict[int, float]
STEP_M = 0.25  # distance between checked positions of a lane


class Looks:
    """The lanes of a map, and the parts of them that a zone must see.

    Args:
        network: the map.
        rect: min_x, min_y, max_x, max_y of the area in which drivers of the zone can be.
        view_m: distance that drivers see along the road.
        see_m: distance to a line at which a driver considers the junction.
        half_m: half the length of the longest vehicle.
    """

    def __init__(
        self,
        network: RoadNetwork,
        rect: tuple[float, float, float, float],
        view_m: float,
        see_m: float,
        half_m: float,
    ) -> None:
        self.network, self.half_m = network, half_m
        self.lengths = network.lanes["length_m"].tolist()
        self.head: dict[int, float] = defaultdict(lambda: -math.inf)
        self.tail: dict[int, float] = defaultdict(lambda: math.inf)
        self.back: dict[int, float] = defaultdict(lambda: math.inf)
        self.line: dict[int, float] = defaultdict(lambda: math.inf)
        self.room: dict[int, float] = defaultdict(lambda: math.inf)
        self.merge: dict[int, float] = defaultdict(lambda: math.inf)
        self.into: dict[int, list[int]] = defaultdict(list)
        for lane in range(len(self.lengths)):
            for other in self._after(lane):
                self.into[other].append(lane)
        self.own = self._own(rect)
        view_m = max(view_m, see_m, LOOK_BACK_M)
        ahead = self._along(view_m)
        asked = self._asked(ahead, see_m)
        foes = {int(conflict["foe"]) for link in asked for conflict in self._conflicts(link)}
        sizes = {*range(1 + sum(2.0 * half_m > length for length in SIZE_LENGTHS_M)), STEERED}
        swept = {
            int(sweep["foe"])
            for link in asked
            for sweep in self._sweeps(link)
            if {int(sweep["own"]), int(sweep["other"])} <= sizes
        }
        foes |= swept
        following = foes
        while (
            following
        ):  # if roads have equal priority, follow cycles of links that yield to each other
            following = {
                int(conflict["foe"])
                for link in following
                if self.network.links["state"][link] == ord("=")
                and self.network.links["signal"][link] < 0
                for conflict in self._conflicts(link)
                if conflict["must_yield"]
            } - foes
            foes = foes | following
        self._at_lines(foes, self.line)
        self._at_lines(swept, self.room)
        self._at_merges(foes)
        for link in asked | foes:
            *inside, lane = self._path(link)
            for each in inside:
                self._see(each, 0.0, self.lengths[each])
            self._see(lane, 0.0, SWEPT_BEYOND_M + half_m)
        crossed = {self._path(link)[-1]: 0.0 for link in asked if len(self._conflicts(link))}
        beyond = self._ways(crossed, self._after, EXIT_LOOK_M)
        for lane, way in beyond.items():
            self._see(lane, 0.0, EXIT_LOOK_M - way)

    def _own(self, rect: tuple[float, float, float, float]) -> dict[int, tuple[float, float]]:
        """Return the part of each lane in the zone with a margin; lanes of an edge are alike."""
        parts: dict[int, list[float]] = defaultdict(list)
        for lane in range(len(self.lengths)):
            row = self.network.lanes[lane]
            points = self.network.points[row["first_point"] :][: row["num_points"]]
            places = np.union1d(np.arange(0.0, points["s"][-1], STEP_M), points["s"])
            x = np.interp(places, points["s"], points["x"])
            y = np.interp(places, points["s"], points["y"])
            inside = (rect[0] <= x) & (x <= rect[2]) & (rect[1] <= y) & (y <= rect[3])
            parts[int(row["edge"])] += places[inside].tolist()
        own = {}
        for lane, length in enumerate(self.lengths):
            part = parts[int(self.network.lanes["edge"][lane])]
            if part:
                first, last = max(min(part) - ASIDE_M, 0.0), max(part) + ASIDE_M
                own[lane] = min(first, length), min(last, length)
        return own

    def _along(self, view_m: float) -> Ways:
        """Add the parts that drivers see ahead and behind; return distances to the lanes ahead."""
        starts: Ways = {}
        ends: Ways = {}
        for lane, (first, last) in self.own.items():
            self._see(lane, first - view_m, last + view_m)
            _shorten(starts, self._after(lane), self.lengths[lane] - last)
            _shorten(ends, self._before(lane), first)
        ahead = self._ways(starts, self._after, view_m)
        for lane, way in ahead.items():
            self._see(lane, 0.0, view_m - way)
        for lane, way in self._ways(ends, self._before, max(LOOK_BACK_M, ENTER_REACH_M)).items():
            for beside in self._beside(lane):
                aside_m = 0.0 if beside == lane else ASIDE_M
                back = way + self.lengths[lane] - aside_m - ROUNDING_M
                self.back[beside] = min(self.back[beside], back)
                for inside, _ in self._beyond(beside):
                    offset = self.lengths[beside] + self.network.lanes["link_offset_m"][inside]
                    self.back[inside] = min(self.back[inside], float(back - offset))
        return ahead

    def _asked(self, ahead: Ways, see_m: float) -> set[int]:
        """Return the links that drivers of the zone are on or may enter."""
        lanes = set()
        for lane, row in enumerate(self.network.lanes):
            if row["internal"]:
                if lane in self.own:
                    lanes.add(int(self.network.links["from_lane"][row["link"]]))
                continue
            if lane in self.own and self.lengths[lane] - self.own[lane][1] <= see_m:
                lanes.add(lane)
            if ahead.get(lane, math.inf) + self.lengths[lane] <= see_m:
                lanes.add(lane)
            if lane in self.own and self.own[lane][0] <= SWEPT_BEYOND_M + self.half_m:
                lanes |= self._leads_to(lane)
        return {
            link for lane in lanes for beside in self._beside(lane) for link in self._links(beside)
        }

    def _leads_to(self, lane: int) -> set[int]:
        """Return the lanes that lead into a lane over the junction at its start."""
        links = self.network.links
        here = (links["to_lane"] == lane) & (links["first_internal"] >= 0)
        return set(links["from_lane"][here].tolist())

    def _at_lines(self, foes: set[int], places: dict[int, float]) -> None:
        """Add the parts in which vehicles register at the stop lines of foes."""
        lines: Ways = {}
        for link in foes:
            _shorten(lines, self._beside(int(self.network.links["from_lane"][link])), 0.0)
        for lane, way in self._ways(lines, self._before, APPROACH_M).items():
            for beside in self._beside(lane):
                line = way + self.lengths[beside] - ROUNDING_M
                places[beside] = min(places[beside], line)

    def _at_merges(self, foes: set[int]) -> None:
        """Add the parts in which drivers see merging vehicles from farther away."""
        lanes, links = self.network.lanes, self.network.links
        before = {k for link in foes for k in self._beside(int(links["from_lane"][link]))}
        for lane in before:
            if not lanes["merges"][lane]:
                continue
            places = [(lane, self.lengths[lane])]
            for link in np.flatnonzero(links["to_lane"] == lane).tolist():
                *inside, _ = self._path(link)
                way = self.lengths[lane]
                for each in reversed(inside):
                    way += self.lengths[each]
                    places.append((each, way))
                if links["state"][link] == ord("M"):
                    beside = self._beside(int(links["from_lane"][link]))
                    places += [(each, way + self.lengths[each]) for each in beside]
            for each, place in places:
                if place - self.lengths[each] < MERGES_M:
                    self.merge[each] = min(self.merge[each], place - ROUNDING_M)

    def _see(self, lane: int, first: float, last: float) -> None:
        for beside in self._beside(lane):
            length = self.lengths[beside]
            if first <= last and last + ASIDE_M >= length:
                for inside, further in self._beyond(beside):
                    self.head[inside] = max(self.head[inside], further + ROUNDING_M)
            if first > last or last < 0.0 or first > length:
                continue
            if first <= 0.0:
                self.head[beside] = max(self.head[beside], last + ROUNDING_M)
            elif last >= length:
                self.tail[beside] = min(self.tail[beside], first - ROUNDING_M)
            else:
                self.head[beside] = math.inf

    def _beyond(self, lane: int) -> list[tuple[int, float]]:
        """Return lanes after a lane, and how far bodies on them overlap longer adjacent lanes."""
        row = self.network.lanes[lane]
        if row["internal"]:
            return []
        sides = [int(row[side]) for side in ("left", "right") if row[side] >= 0]
        ends = [beside_s(self.network, lane, side, self.lengths[lane]) for side in sides]
        more = [self.lengths[k] - end for k, end in zip(sides, ends, strict=True)]
        if max(more, default=0.0) <= GOES_ON_M:
            return []
        found = []
        for link in self._links(lane):
            for inside in self._path(link)[:-1]:
                rest = max(more) + self.half_m - self.network.lanes["link_offset_m"][inside]
                if rest + ROUNDING_M > 0.0:
                    found.append((inside, rest + ROUNDING_M))
        return found

    def _ways(self, begin: Ways, neighbors: Callable[[int], list[int]], limit_m: float) -> Ways:
        """Return the shortest distances to lanes by Dijkstra's algorithm."""
        found: Ways = {}
        waiting = [(way, lane) for lane, way in begin.items() if way <= limit_m]
        heapq.heapify(waiting)
        while waiting:
            way, lane = heapq.heappop(waiting)
            if lane in found:
                continue
            found[lane] = way
            further = way + self.lengths[lane]
            if further <= limit_m:
                for other in neighbors(lane):
                    heapq.heappush(waiting, (further, other))
        return found

    def _links(self, lane: int) -> list[int]:
        row = self.network.lanes[lane]
        return list(range(row["first_link"], row["first_link"] + row["num_links"]))

    def _after(self, lane: int) -> list[int]:
        if self.network.lanes["internal"][lane]:
            return [int(self.network.lanes["successor"][lane])]
        return [int(self.network.links["next_lane"][link]) for link in self._links(lane)]

    def _before(self, lane: int) -> list[int]:
        return self.into[lane]

    def _beside(self, lane: int) -> list[int]:
        edge = self.network.lanes["edge"][lane]
        beside: list[int] = np.flatnonzero(self.network.lanes["edge"] == edge).tolist()
        return beside

    def _path(self, link: int) -> list[int]:
        """Return the lanes of a link inside the junction, and the lane after the junction."""
        path = [int(self.network.links["next_lane"][link])]
        while self.network.lanes["internal"][path[-1]]:
            path += self._after(path[-1])
        return path

    def _sweeps(self, link: int) -> NDArray[np.void]:
        row = self.network.links[link]
        found: NDArray[np.void] = self.network.sweeps[row["first_sweep"] :]
        return found[: row["num_sweeps"]]

    def _conflicts(self, link: int) -> NDArray[np.void]:
        row = self.network.links[link]
        found: NDArray[np.void] = self.network.conflicts[row["first_conflict"] :]
        return found[: row["num_conflicts"]]


def _shorten(ways: Ways, lanes: Iterable[int], way: float) -> None:
    for lane in lanes:
        ways[lane] = min(ways.get(lane, math.inf), way)
