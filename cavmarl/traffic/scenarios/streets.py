"""`Streets`: queries on a road network, with which scenarios find and describe places."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import atan2, cosine, hypot, sine
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.roads.routing import lane_grid

STRAIGHT_RAD = 0.05  # maximum change of direction of a straight lane
BESIDE_M = 8.0  # maximum distance between the centres of neighbouring lanes of a road
LOOK_MARGIN_M = 0.3
ACROSS_M = 1.0  # maximum distance between an area shared by two paths and each of the paths


class Crossing(NamedTuple):
    """Two movements over a junction that share an area."""

    link: int  # LINK row of the first movement
    foe: int  # LINK row of the second movement
    middle_m: float  # centre of the area, from the stop line of the first movement
    foe_middle_m: float  # centre of the area, from the stop line of the second movement


class Opposite(NamedTuple):
    """The neighbour of a lane in the opposite direction."""

    lane: int
    s: float  # m, place on the lane
    apart_m: float  # distance between the centres of both lanes


class Streets:
    """Queries on a road network."""

    def __init__(self, network: RoadNetwork) -> None:
        self.network = network
        self._grid = lane_grid(network)
        self.inwards = -1 if network.left_hand else 1  # sign towards the road's middle

    def point(self, lane: int, s: float, d: float = 0.0) -> NDArray[np.float64]:
        """Return (3,) x, y and heading of a place on a lane, `d` m left of its centre."""
        x, y, _, cos, sin, _ = self.network.pose_on(lane, s)
        return np.array([x - d * sin, y + d * cos, atan2(sin, cos)])

    @property
    def _sides(self) -> tuple[str, str]:
        """Names of the LANE fields of the neighbours towards the kerb and towards the middle."""
        return ("left", "right") if self.network.left_hand else ("right", "left")

    @property
    def across(self) -> str:
        """SUMO's letters for turns across the road."""
        return "rR" if self.network.left_hand else "lL"

    def is_at_kerb(self, lane: int) -> bool:
        return int(self.network.lanes[self._sides[0]][lane]) < 0

    def inside(self, lane: int, s: float, aside_m: float) -> NDArray[np.float64]:
        """Return `point`, moved by `aside_m` towards the middle of the road."""
        return self.point(lane, s, self.inwards * aside_m)

    def edge(self, lane: int) -> int:
        return int(self.network.lanes["edge"][lane])

    def length_m(self, lane: int) -> float:
        return float(self.network.lanes["length_m"][lane])

    def straights(self, least_m: float) -> list[int]:
        """Return straight LANE rows for cars outside junctions, at least `least_m` long."""
        lanes = self.network.lanes
        good = ~lanes["internal"] & (lanes["permissions"] & CARS != 0)
        good &= lanes["length_m"] >= least_m
        return [lane for lane in np.flatnonzero(good).tolist() if self._bend(lane) < STRAIGHT_RAD]

    def kerbs_m(self, lane: int, s: float) -> tuple[float, float]:
        """Return the distances in m from a lane's centre to the near and far side of the road."""
        lanes = self.network.lanes
        sides = []
        for side in self._sides:
            at, reach = lane, 0.5 * float(lanes["width_m"][lane])
            while lanes[side][at] >= 0:
                at = int(lanes[side][at])
                reach += float(lanes["width_m"][at])
            sides.append(reach)
        near, far = sides
        while (beyond := self._lane_at(self.inside(lane, s, far + LOOK_MARGIN_M))) >= 0:
            far += float(lanes["width_m"][beyond])
        return near, far

    def opposite(self, lane: int, s: float) -> Opposite | None:
        """Return the adjacent lane in the opposite direction, if there is one."""
        here = self.network.lanes[lane]
        if here[self._sides[1]] >= 0:
            return None
        x, y, heading = self.inside(lane, s, 0.5 * float(here["width_m"]) + LOOK_MARGIN_M)
        other = self._lane_at(np.array([x, y, heading]))
        if other < 0:
            return None
        middle = self.point(lane, s)
        place, d, cos, sin = self.network.beside(other, middle[0], middle[1])
        along = cos * cosine(heading) + sin * sine(heading)
        if along > -0.99 or abs(d) > BESIDE_M:
            return None
        return Opposite(other, place, abs(d))

    def crossings(self, directions: str, *, yields: bool, merges: bool) -> Iterator[Crossing]:
        """Yield pairs of car movements that share an area; the second movement is straight.

        `directions`: SUMO's letters for the first movement, such as `s` or `lL`. `yields`: whether
        the first movement must yield to the second. `merges`: whether both lead into one lane.
        """
        links, conflicts, lanes = self.network.links, self.network.conflicts, self.network.lanes
        ends = lanes["permissions"][links["from_lane"]] & lanes["permissions"][links["to_lane"]]
        for_cars = ends & CARS != 0
        own = np.repeat(np.arange(len(links)), links["num_conflicts"])
        foe = conflicts["foe"]
        good = for_cars[own] & for_cars[foe] & (links["first_internal"][foe] >= 0)
        good &= np.isin(links["direction"][own], [ord(letter) for letter in directions])
        good &= links["direction"][foe] == ord("s")
        good &= (conflicts["merging"] == merges) & (conflicts["must_yield"] == yields)
        for c in np.flatnonzero(good):
            row = conflicts[c]
            crossing = Crossing(
                int(own[c]),
                int(foe[c]),
                0.5 * float(row["enter_m"] + row["leave_m"]),
                0.5 * float(row["foe_enter_m"] + row["foe_leave_m"]),
            )
            if merges or self.apart_m(crossing) < ACROSS_M:
                yield crossing

    def apart_m(self, crossing: Crossing) -> float:
        """Return the distance from the shared area's centre on the foe's path to the ego path."""
        rest, lane = crossing.foe_middle_m, int(self.network.links["first_internal"][crossing.foe])
        while rest > self.length_m(lane) and self.network.lanes["internal"][lane]:
            rest -= self.length_m(lane)
            lane = int(self.network.lanes["successor"][lane])
        x, y, _ = self.point(lane, rest)
        own = int(self.network.links["first_internal"][crossing.link])
        nearest = math.inf
        while own >= 0 and self.network.lanes["internal"][own]:
            s, d, _, _ = self.network.beside(own, x, y)
            beyond = max(-s, s - self.length_m(own), 0.0)
            nearest = min(nearest, hypot(d, beyond))
            own = int(self.network.lanes["successor"][own])
        return nearest

    def movements(self, directions: str) -> list[int]:
        """Return LINK rows of car movements with SUMO's direction letters, such as `s` or `lL`."""
        links, lanes = self.network.links, self.network.lanes
        ends = lanes["permissions"][links["from_lane"]] & lanes["permissions"][links["to_lane"]]
        good = (ends & CARS != 0) & (links["first_internal"] >= 0)
        good &= np.isin(links["direction"], [ord(letter) for letter in directions])
        found: list[int] = np.flatnonzero(good).tolist()
        return found

    def onward(self, lane: int) -> int | None:
        """Return the next lane for cars beyond a junction, preferably straight on.

        The result is None if cars cannot continue.
        """
        links, lanes = self.network.links, self.network.lanes
        first = int(lanes["first_link"][lane])
        ways = [
            link for link in range(first, first + int(lanes["num_links"][lane]))
            if lanes["permissions"][links["to_lane"][link]] & CARS
        ]  # fmt: skip
        ways.sort(key=lambda link: (links["direction"][link] != ord("s"), link))
        return int(links["to_lane"][ways[0]]) if ways else None

    def lanes_beside(self, lane: int) -> list[int]:
        """Return all lanes of the same road and direction, from the kerb to the middle."""
        outer, inner = (self.network.lanes[side] for side in self._sides)
        while outer[lane] >= 0:
            lane = int(outer[lane])
        found = [lane]
        while inner[found[-1]] >= 0:
            found.append(int(inner[found[-1]]))
        return found

    def turn_rad(self, one: int, other: int) -> float:
        """Return the unsigned angle between the ends of the lanes that two links leave."""
        ends = [int(self.network.links["from_lane"][link]) for link in (one, other)]
        first, second = (self.point(lane, self.length_m(lane))[2] for lane in ends)
        return abs(math.remainder(first - second, 2.0 * math.pi))

    def upstream(self, lane: int, far_m: float) -> tuple[tuple[int, ...], float] | None:
        """Return lanes that lead to a lane, and the total length up to its end.

        The given lane is the last. The result is None if the lanes are shorter than `far_m` in
        total.
        """
        found, way_m = [lane], self.length_m(lane)
        while way_m < far_m:
            before = self.before(found[0])
            if before is None or before in found:
                return None
            found.insert(0, before)
            way_m += self.length_m(before)
        return tuple(found), way_m

    def before(self, lane: int) -> int | None:
        """Return the first lane from which cars enter a lane, or None."""
        lanes, into = self.network.lanes, self.network.into
        row = lanes[lane]
        ends = into[row["first_into"] : row["first_into"] + row["num_into"]]
        return next((k for k in ends.tolist() if lanes["permissions"][k] & CARS), None)

    def name(self, lane: int) -> str:
        return self.network.lane_ids[lane]

    def _bend(self, lane: int) -> float:
        return float(np.ptp(np.unwrap(self.network.lane_points(lane)["heading"])))

    def _lane_at(self, place: NDArray[np.float64]) -> int:
        """Return the lane outside junctions that contains a place, or -1."""
        grid, (x, y, _) = self._grid, place.tolist()
        column, line = int((x - grid.min_x) // grid.cell_m), int((y - grid.min_y) // grid.cell_m)
        if not (0 <= column < grid.num_x and 0 <= line < grid.num_y):
            return -1
        cell = line * grid.num_x + column
        for lane in grid.cell_lanes[grid.cell_start[cell] : grid.cell_start[cell + 1]].tolist():
            row = self.network.lanes[lane]
            if row["internal"]:
                continue
            s, d, _, _ = self.network.beside(lane, x, y)
            if abs(d) < 0.5 * row["width_m"] and 0.0 <= s <= row["length_m"]:
                return int(lane)
        return -1
