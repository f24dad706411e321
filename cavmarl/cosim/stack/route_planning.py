"""Planning on the lane graph: the route to the goal, and the acceleration along it.

The route comes from `roads.routing.make_plans`, without traffic. The acceleration is the minimum of
the Intelligent Driver Model (Treiber, Hennecke, Helbing, 2000) over all obstacles on the route. A
line where a signal or a vehicle with the right of way requires a stop counts as a stopped obstacle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import wrap_angle
from cavmarl.core.records.codes import (
    SIGNAL_GREEN_MAJOR,
    SIGNAL_NONE,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.cosim.stack.hd_map import HdMap, OnLane
from cavmarl.cosim.stack.stack_types import EgoPose, Mission, Obstacle, Trajectory
from cavmarl.roads.routing import make_plans

_AHEAD_M = 70.0
_MATCH_M = 5.0
_HEADING_COST_M = 3.0  # 1 rad between vehicle and lane counts like this lateral distance
_EXPECTED_M = 1.5  # preference for a lane on the previous route
_ACCEL, _DECEL, _HEADWAY_S, _GAP_M = 1.5, 2.5, 1.4, 2.0  # of the IDM; accelerations in m/s²
_HARDEST = 6.0  # maximum braking, m/s²
_BESIDE_M = 0.3  # lateral distance kept to an obstacle beside the route
_BESIDE_WALKER_M = 0.8  # the same for a pedestrian
_WALK_S = 3.0  # time for which a pedestrian's walk is extrapolated
_BEND_MPS2 = 2.0  # maximum lateral acceleration
_BRAKE_FOR_YELLOW = 3.0  # stop at yellow if less braking than this suffices, m/s²
# Yield to a vehicle with the right of way within this time or distance of its line.
_CLEAR_S = 4.0
_CLEAR_M = 12.0
_CHANGE_BEHIND_M, _CHANGE_AHEAD_M = 10.0, 6.0  # free distances for a lane change at equal speeds
_SIGHT_M = 50.0  # distance from which a line is considered
_STANDS_MPS = 0.7


class _Limit(NamedTuple):
    accel: float
    reason: str


class LaneRoute:
    """The planning stage `lane_route`."""

    def __init__(self, hd_map: HdMap) -> None:
        self._map = hd_map
        self._network = hd_map.network
        self._expected: tuple[int, ...] = ()

    def plan(
        self,
        pose: EgoPose,
        obstacles: Sequence[Obstacle],
        signals: NDArray[np.uint8] | None,
        mission: Mission,
    ) -> Trajectory:
        plan = _plan_of(self._map, mission.goal_edge, mission.vclass)
        here = self._here(pose, plan)
        if here is None:
            straight = np.array([[0.0, 0.0], [10.0, 0.0]]) @ _turn(pose.heading_rad)
            return Trajectory(straight + np.array([pose.x_m, pose.y_m]), -_DECEL, "end")
        here = self._change_lane(here, pose, plan, obstacles)
        lanes, starts, points, ends = self._way(here, plan)
        self._expected = tuple(lanes)
        limits = [
            self._free(pose, here, lanes, starts, points),
            *self._gaps(pose, points, obstacles, mission),
            *self._lines(pose, lanes, starts, plan, obstacles, signals, mission),
        ]
        if ends is not None:
            limits.append(_Limit(_behind(pose.speed_mps, 0.0, ends), "end"))
        hardest = min(limits, key=lambda limit: limit.accel)
        return Trajectory(points, max(hardest.accel, -_HARDEST), hardest.reason, lanes)

    def _here(self, pose: EgoPose, plan: NDArray[np.void]) -> OnLane | None:
        """Return the nearby lane that fits the vehicle best and leads to the goal, or None."""
        best, least = None, math.inf
        for place in self._map.near(pose.x_m, pose.y_m, _MATCH_M):
            apart = abs(wrap_angle(pose.heading_rad - place.heading_rad))
            if not np.isfinite(plan["to_go"][place.lane]) or apart > 1.2:
                continue
            cost = abs(place.d_m) + _HEADING_COST_M * apart
            cost -= _EXPECTED_M if place.lane in self._expected else 0.0
            if cost < least:
                best, least = place, cost
        return best

    def _change_lane(
        self, here: OnLane, pose: EgoPose, plan: NDArray[np.void], obstacles: Sequence[Obstacle]
    ) -> OnLane:
        """Return the lane beside the current one if the route needs it and there is room."""
        change = int(plan["change"][here.lane])
        row = self._network.lanes[here.lane]
        if change == 0 or row["internal"]:
            return here
        beside = int(row["left"] if change > 0 else row["right"])
        if beside < 0:
            return here
        there = self._map.on_lane(beside, pose.x_m, pose.y_m)
        for obstacle in obstacles:
            place = self._map.on_lane(beside, obstacle.x_m, obstacle.y_m)
            half = 0.5 * obstacle.length_m
            gap = place.s_m - there.s_m
            speed = math.hypot(obstacle.vx_mps, obstacle.vy_mps)
            behind = _CHANGE_BEHIND_M + max(0.0, speed - pose.speed_mps) * 2.0 + half
            ahead = _CHANGE_AHEAD_M + max(0.0, pose.speed_mps - speed) * 2.0 + half
            if abs(place.d_m) < 0.5 * float(row["width_m"]) and -behind < gap < ahead:
                return here
        return there

    def _way(
        self, here: OnLane, plan: NDArray[np.void]
    ) -> tuple[list[int], list[float], NDArray[np.float64], float | None]:
        """Return the lanes ahead, their starts (m), the route's points, and where to wait (m)."""
        lanes, starts = [here.lane], [-here.s_m]
        pieces = [self._map.polyline(here.lane, here.s_m)]
        reached = float(self._network.lanes["length_m"][here.lane]) - here.s_m
        ends = None
        while reached < _AHEAD_M:
            following = int(plan["next"][lanes[-1]])
            if plan["change"][lanes[-1]] != 0 or following < 0:
                # If a lane change is needed, the end of the lane is the place to wait for it.
                ends = reached if plan["change"][lanes[-1]] != 0 else None
                break
            lanes.append(following)
            starts.append(reached)
            pieces.append(self._map.polyline(following, 0.0))
            reached += float(self._network.lanes["length_m"][following])
        points = np.concatenate(pieces)
        apart = np.hypot(*np.diff(points, axis=0).T)
        kept = np.concatenate([[True], apart > 0.05])
        points = points[kept]
        if len(points) < 2:
            step = np.array([math.cos(here.heading_rad), math.sin(here.heading_rad)])
            points = np.stack([points[0], points[0] + step])
        return lanes, starts, points, ends

    def _free(
        self,
        pose: EgoPose,
        here: OnLane,
        lanes: Sequence[int],
        starts: Sequence[float],
        points: NDArray[np.float64],
    ) -> _Limit:
        """Return the acceleration for the lanes' speed limits and for bends."""
        speed = max(pose.speed_mps, 0.1)
        limit = float(self._network.lanes["speed_mps"][here.lane])
        accel = _ACCEL * (1.0 - (speed / limit) ** 4)
        for lane, start in zip(lanes[1:], starts[1:], strict=True):
            ahead = float(self._network.lanes["speed_mps"][lane])
            accel = min(accel, _slow_to(speed, ahead, start))
        for distance, allowed in _bends(points):
            accel = min(accel, _slow_to(speed, allowed, distance))
        return _Limit(accel, "free")

    def _gaps(
        self,
        pose: EgoPose,
        points: NDArray[np.float64],
        obstacles: Sequence[Obstacle],
        mission: Mission,
    ) -> list[_Limit]:
        found = []
        for obstacle in obstacles:
            s, d, cos, sin = _beside(points, obstacle.x_m, obstacle.y_m)
            half_width = 0.5 * max(obstacle.width_m, 0.5)
            on_foot = obstacle.kind == "pedestrian"
            free = 0.5 * mission.width_m + half_width + (_BESIDE_WALKER_M if on_foot else _BESIDE_M)
            least = abs(d)
            if on_foot:  # the pedestrian's position when the vehicle arrives there
                aside = obstacle.vy_mps * cos - obstacle.vx_mps * sin
                soon = d + aside * min(s / max(pose.speed_mps, 1.0), _WALK_S)
                least = 0.0 if d * soon < 0.0 else min(least, abs(soon))
            if s <= 0.0 or least > free:
                continue
            gap = s - 0.5 * obstacle.length_m - 0.5 * mission.length_m
            speed = max(0.0, obstacle.vx_mps * cos + obstacle.vy_mps * sin)
            limit = _behind(pose.speed_mps, 0.0 if on_foot else speed, gap)
            found.append(_Limit(limit, "pedestrian" if on_foot else "gap"))
        return found

    def _lines(
        self,
        pose: EgoPose,
        lanes: Sequence[int],
        starts: Sequence[float],
        plan: NDArray[np.void],
        obstacles: Sequence[Obstacle],
        signals: NDArray[np.uint8] | None,
        mission: Mission,
    ) -> list[_Limit]:
        found = []
        for lane, start in zip(lanes, starts, strict=True):
            link = int(plan["link"][lane])
            row = self._network.lanes[lane]
            if link < 0 or row["internal"] or plan["change"][lane] != 0:
                continue
            line = start + float(row["length_m"]) - float(row["stop_back_m"])
            gap = line - 0.5 * mission.length_m
            if gap < -1.0 or gap > _SIGHT_M:
                continue
            code = SIGNAL_NONE if signals is None else int(signals[link])
            reason = self._stops(link, code, pose, gap, obstacles)
            if reason:
                # The model keeps _GAP_M from vehicles; half a metre suffices before a line.
                room = gap + _GAP_M - 0.5
                found.append(_Limit(_behind(pose.speed_mps, 0.0, room), reason))
        return found

    def _stops(
        self, link: int, code: int, pose: EgoPose, gap: float, obstacles: Sequence[Obstacle]
    ) -> str:
        if code in (SIGNAL_RED, SIGNAL_RED_YELLOW):
            return "stop_line"
        if code in (SIGNAL_YELLOW_MINOR, SIGNAL_YELLOW_MAJOR):
            needed = pose.speed_mps**2 / (2.0 * max(gap, 0.1))
            return "stop_line" if needed < _BRAKE_FOR_YELLOW else ""
        if code != SIGNAL_GREEN_MAJOR and self._must_yield(link, obstacles):
            return "yield"
        return ""

    def _must_yield(self, link: int, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether a vehicle with the right of way is in the junction or about to enter."""
        network = self._network
        row = network.links[link]
        conflicts = network.conflicts[
            row["first_conflict"] : row["first_conflict"] + row["num_conflicts"]
        ]
        foes = conflicts["foe"][conflicts["must_yield"]]
        if not foes.size:
            return False
        inside = {int(network.links["first_internal"][foe]) for foe in foes}
        before = {int(network.links["from_lane"][foe]) for foe in foes}
        for obstacle in obstacles:
            speed = math.hypot(obstacle.vx_mps, obstacle.vy_mps)
            if speed < _STANDS_MPS:
                continue
            course = math.atan2(obstacle.vy_mps, obstacle.vx_mps)
            for place in self._map.near(obstacle.x_m, obstacle.y_m, 2.5):
                if abs(wrap_angle(course - place.heading_rad)) > 1.0:
                    continue
                left = float(network.lanes["length_m"][place.lane]) - place.s_m
                if place.lane in inside or (
                    place.lane in before and (left < speed * _CLEAR_S or left < _CLEAR_M)
                ):
                    return True
        return False


@lru_cache(maxsize=64)
def _plan_of(hd_map: HdMap, goal_edge: int, vclass: str) -> NDArray[np.void]:
    """Return PLAN (L,) to a goal."""
    plan: NDArray[np.void] = make_plans(hd_map.network, [goal_edge], vclass)[0]
    return plan


def _turn(heading: float) -> NDArray[np.float64]:
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([[cos, sin], [-sin, cos]])


def _behind(speed: float, ahead_mps: float, gap: float) -> float:
    """Return the IDM's acceleration behind an obstacle, without its free-road term."""
    closing = speed * (speed - ahead_mps) / (2.0 * math.sqrt(_ACCEL * _DECEL))
    wanted = _GAP_M + max(0.0, speed * _HEADWAY_S + closing)
    return _ACCEL * (1.0 - (wanted / max(gap, 0.1)) ** 2)


def _slow_to(speed: float, allowed: float, distance: float) -> float:
    """Return the acceleration to reach a lower speed in time; _ACCEL: braking is not needed yet."""
    if speed <= allowed:
        return _ACCEL if distance > 0.0 else min(_ACCEL, allowed - speed)
    needed = (speed**2 - allowed**2) / (2.0 * max(distance, 1.0))
    return -needed if needed > 0.5 * _DECEL else _ACCEL


def _bends(points: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Return bends as pairs: distance in m from the start of the route, and speed."""
    steps = np.diff(points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    found = []
    for s in np.arange(0.0, min(float(along[-1]), 45.0), 3.0):
        low, high = np.searchsorted(along, [s, s + 6.0])
        turn = abs(float(headings[min(high, len(headings)) - 1] - headings[max(low - 1, 0)]))
        if turn > 0.1:
            found.append((float(s), math.sqrt(_BEND_MPS2 * 6.0 / turn)))
    return found


def _beside(
    points: NDArray[np.float64], x_m: float, y_m: float
) -> tuple[float, float, float, float]:
    """Return s and d of a place relative to a route, and cos and sin of the route's heading."""
    steps = np.diff(points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    units = steps / lengths[:, None]
    offset = np.array([x_m, y_m]) - points[:-1]
    raw = (offset * units).sum(axis=1)
    share = np.clip(raw, 0.0, lengths)
    off = np.hypot(*(offset - share[:, None] * units).T)
    k = int(np.argmin(off))
    cos, sin = units[k].tolist()
    before = float(lengths[:k].sum())
    s = before + float(raw[k] if k == 0 else share[k])
    d = float(offset[k, 1] * cos - offset[k, 0] * sin)
    beyond = k == len(lengths) - 1 and raw[k] > lengths[k]
    return s, (float(off[k]) if beyond else d), cos, sin
