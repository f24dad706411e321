"""Which lanes a body covers, and which stretch of each."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import lane_pose, project
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.routing import lane_grid
from cavmarl.traffic.scenarios.motions import Pose

SAMPLE_M = 0.5  # between the points of a body that are looked at
LEVEL_M = 4.0  # lanes that differ by more in height are one above the other
FARTHEST_M = 200.0  # from an actor to a lane
ON_ROAD = (1 << len(VEHICLE_CLASSES)) - 1


class Shadow(NamedTuple):
    """A stretch of a lane that a body covers."""

    start: float  # in m along the lane
    end: float  # in m along the lane
    speed: float  # of the body along the lane in m/s, not below 0

    def joined(self, other: Shadow) -> Shadow:
        """The stretch from the start of the first to the end of the last."""
        return Shadow(min(self.start, other.start), max(self.end, other.end), 0.0)


class Shadows:
    """Looks up lanes below bodies."""

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._grid = lane_grid(network)

    def of(self, pose: Pose, length: float, width: float) -> dict[int, Shadow]:
        """By LANE row, what a body of this size covers in its place."""
        points = _outline(pose, length, width)
        found = {}
        for lane in self._near(points):
            row = self._network.lanes[lane]
            if not self._is_level(lane, pose.beside):
                continue
            places = [self._project(lane, x, y) for x, y in points]
            reach = 0.5 * float(row["width_m"])
            length_m = float(row["length_m"])
            covered = [s for s, d in places if abs(d) < reach and 0.0 <= s <= length_m]
            if covered:
                start, end = min(covered), max(covered)
                _, _, _, cos, sin, _ = self._pose(lane, 0.5 * (start + end))
                along = math.cos(pose.heading) * cos + math.sin(pose.heading) * sin
                found[lane] = Shadow(start, end, max(pose.speed * along, 0.0))
        return found

    def nearest(self, pose: Pose) -> tuple[int, float, float]:
        """The lane whose stretch is nearest to a place, and s and d there."""
        best, best_off = (pose.beside, 0.0, 0.0), math.inf
        for lane in self._around(pose.x, pose.y):
            if not self._is_level(lane, pose.beside):
                continue
            s, d = self._project(lane, pose.x, pose.y)
            length = float(self._network.lanes["length_m"][lane])
            on = min(max(s, 0.0), length)
            off = math.hypot(abs(s - on), d)
            if off < best_off:
                best, best_off = (lane, on, d), off
        return best

    def height_m(self, lane: int, s: float) -> float:
        return self._pose(lane, s)[2]

    def distance_m(self, lane: int, s: float, pose: Pose) -> float:
        """From a place on a lane to an actor, in the plane."""
        x, y, *_ = self._pose(lane, s)
        return math.hypot(x - pose.x, y - pose.y)

    def _is_level(self, lane: int, other: int) -> bool:
        """Whether two lanes that are near each other can be on the same road."""
        z = self._network.points["z"][self._network.lanes["first_point"][[lane, other]]]
        return bool(abs(z[0] - z[1]) < LEVEL_M)

    def _near(self, points: NDArray[np.float64]) -> list[int]:
        cells = {self._cell(x, y) for x, y in points}
        return sorted({lane for cell in cells for lane in self._members(cell)})

    def _around(self, x: float, y: float) -> list[int]:
        """Lanes of the nearest cells that have any, by rising rows."""
        step = self._grid.cell_m
        for ring in range(1, int(FARTHEST_M / step) + 1):
            offsets = np.arange(-ring, ring + 1) * step
            cells = {self._cell(x + dx, y + dy) for dx in offsets for dy in offsets}
            if found := sorted({lane for cell in cells for lane in self._members(cell)}):
                return found
        return list(range(len(self._network.lanes)))

    def _cell(self, x: float, y: float) -> int:
        grid = self._grid
        column = min(max(int((x - grid.min_x) // grid.cell_m), 0), grid.num_x - 1)
        line = min(max(int((y - grid.min_y) // grid.cell_m), 0), grid.num_y - 1)
        return line * grid.num_x + column

    def _members(self, cell: int) -> list[int]:
        start = self._grid.cell_start
        lanes: list[int] = self._grid.cell_lanes[start[cell] : start[cell + 1]].tolist()
        return [lane for lane in lanes if self._network.lanes["permissions"][lane] & ON_ROAD]

    def _project(self, lane: int, x: float, y: float) -> tuple[float, float]:
        row = self._network.lanes[lane]
        s, d, _, _ = project(self._network.points, row["first_point"], row["num_points"], x, y)
        return s, d

    def _pose(self, lane: int, s: float) -> tuple[float, float, float, float, float, float]:
        row = self._network.lanes[lane]
        return lane_pose(self._network.points, row["first_point"], row["num_points"], s)


def _outline(pose: Pose, length: float, width: float) -> NDArray[np.float64]:
    """(n, 2) points all over a body, its corners among them."""
    along = np.linspace(-0.5, 0.5, max(2, round(length / SAMPLE_M) + 1)) * length
    across = np.linspace(-0.5, 0.5, max(2, round(width / SAMPLE_M) + 1)) * width
    u, v = (grid.ravel() for grid in np.meshgrid(along, across))
    cos, sin = math.cos(pose.heading), math.sin(pose.heading)
    return np.stack([pose.x + u * cos - v * sin, pose.y + u * sin + v * cos], axis=1)
