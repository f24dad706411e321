"""`MapDriver`: a driver on a vector map, which observes objects, lights and rights of way.

Each obstacle on the way gives an acceleration by the Intelligent Driver Model (Treiber, Hennecke,
Helbing, 2000). A line at which the vehicle has to stop is an obstacle, too. The driver uses the
smallest acceleration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.vector_map import CHANGE_S, MapLanelet, VectorMap, wrapped
from cavmarl.cosim.stack.stack import PurePursuit
from cavmarl.cosim.stack.stack_types import EgoPose, Mission, Trajectory

LENGTH_M, WIDTH_M, WHEELBASE_M = 5.0, 2.0, 5.0  # dimensions of the driven vehicle
AHEAD_M = 90.0
ACCEL, BRAKE, HARDEST = 1.5, 2.5, 6.0  # m/s²; the last is the maximum braking
HEADWAY_S, GAP_M = 1.4, 2.5
BEND_MPS2 = 1.8  # maximum lateral acceleration in bends
BESIDE_M = 0.4  # distance to objects beside the way
LINE_M = 1.0  # distance of the front to a line when stopped
SIGHT_M = 60.0  # the driver considers lines, and foes before a crossing, within this distance
MARGIN_S = 1.5  # a foe must arrive at least this long after the driver has passed
PATIENCE_S = 20.0  # waiting time after which standing foes do not count
GREEN, AMBER = 3, 2  # colours of Autoware's TrafficLightElement


class Seen(NamedTuple):
    """A perceived object."""

    place: NDArray[np.float64]  # (2,) position of its centre, m
    heading: float
    speed_mps: float
    length_m: float
    width_m: float


class Piece(NamedTuple):
    """A lanelet of the route, with its position along the route."""

    lanelet: MapLanelet
    begin_m: float  # position of the start of the lanelet along the route


class MapDriver:
    """A driver on a vector map.

    `tick_s`: time between two calls of `drive`.
    """

    def __init__(self, vector_map: VectorMap, tick_s: float) -> None:
        self._map, self._tick_s = vector_map, tick_s
        self._costs: dict[int, float] = {}
        self.begin(np.zeros(2), 0.0)

    def begin(self, goal: NDArray[np.float64], heading: float) -> None:
        """Set a new destination (2,) and the heading of its road."""
        self._costs = self._map.costs_to(goal, heading)
        self._control = PurePursuit(self._tick_s)
        self._expected: set[int] = set()
        self._waited_s = 0.0
        self.reason = ""

    def drive(
        self, pose: EgoPose, objects: Sequence[Seen], lights: Mapping[int, frozenset[int]]
    ) -> tuple[float, float]:
        """Return acceleration in m/s² and angle of the front wheels in rad.

        `pose`: pose of the centre of the vehicle. `lights`: lit colours by id of the light.
        """
        place = np.array([pose.x_m, pose.y_m])
        here = self._here(place, pose.heading_rad)
        mission = Mission(0, "passenger", WHEELBASE_M, WIDTH_M)
        if here is None:
            self.reason = "off the map"
            straight = place + np.array([[0.0], [1.0], [20.0]]) * _direction(pose.heading_rad)
            found = self._control.control(pose, Trajectory(straight, -BRAKE), mission)
            return found.accel_mps2, found.steering_rad
        here, must_change = self._change(here, place, pose, objects)
        pieces, points, s0 = self._way(here, place, pose)
        front_m = s0 + 0.5 * LENGTH_M
        limits = [
            (self._bend(pose, points), "bend"),
            (self._speeds(pose, pieces, front_m), "limit"),
            *self._gaps(pose, points, objects),
            *self._lines(pose, pieces, front_m, objects, lights),
        ]
        if must_change:
            end_m = pieces[0].begin_m + here.length_m - 4.0
            limits.append((self._stop(pose, end_m - front_m), "change"))
        accel, self.reason = min(limits)
        self._waited_s = self._waited_s + self._tick_s if pose.speed_mps < 0.3 else 0.0
        self._expected = {piece.lanelet.id for piece in pieces}
        found = self._control.control(pose, Trajectory(points, accel), mission)
        return found.accel_mps2, found.steering_rad

    def _here(self, place: NDArray[np.float64], heading: float) -> MapLanelet | None:
        best, least = None, math.inf
        for one in self._map.near(place, 5.0):
            _, off, direction = one.project(place)
            turn = abs(wrapped(heading - direction))
            if one.id not in self._costs or turn > 1.2:
                continue
            cost = abs(off) + 3.0 * turn - 1.5 * (one.id in self._expected)
            if cost < least:
                best, least = one, cost
        return best

    def _next(self, one: MapLanelet) -> MapLanelet | None:
        known = [after for after in one.after if after.id in self._costs]
        return min(known, key=lambda after: self._costs[after.id]) if known else None

    def _change(
        self,
        here: MapLanelet,
        place: NDArray[np.float64],
        pose: EgoPose,
        objects: Sequence[Seen],
    ) -> tuple[MapLanelet, bool]:
        """Return the lanelet to drive on, and whether only a lane change continues the route."""
        then = self._next(here)
        staying = math.inf if then is None else self._costs[then.id]
        staying += here.length_m / here.speed_mps
        is_goal = self._costs[here.id] <= here.length_m / here.speed_mps + 1e-6
        for other in here.beside:
            if is_goal or self._costs.get(other.id, math.inf) + CHANGE_S >= staying - 1e-6:
                continue
            s, *_ = other.project(place)
            if all(not _blocks(other, s, pose.speed_mps, each) for each in objects):
                return other, False
            return here, then is None or math.isinf(staying) or staying > self._costs[here.id] + 1.0
        return here, False

    def _way(
        self, here: MapLanelet, place: NDArray[np.float64], pose: EgoPose
    ) -> tuple[list[Piece], NDArray[np.float64], float]:
        """Return the lanelets and points of the route, and the vehicle's s on the first lanelet.

        The points begin beside the vehicle, and approach the centres of the lanelets.
        """
        s0, off, _ = here.project(place)
        pieces, length_m = [Piece(here, 0.0)], here.length_m
        points, along = [here.centre], [here.along_m]
        one: MapLanelet | None = here
        while length_m < s0 + AHEAD_M and one is not None:
            one = self._next(one)
            if one is None or one.id in {piece.lanelet.id for piece in pieces}:
                break
            pieces.append(Piece(one, length_m))
            points.append(one.centre[1:])
            along.append(length_m + one.along_m[1:])
            length_m += one.length_m
        centre, at = np.concatenate(points), np.concatenate(along)
        grid = np.arange(s0, max(min(length_m, s0 + AHEAD_M), s0 + 2.0), 1.0)
        way = np.stack([np.interp(grid, at, axis) for axis in centre.T], axis=1)
        steps = np.gradient(way, axis=0)
        left = np.stack([-steps[:, 1], steps[:, 0]], axis=1)
        left /= np.maximum(np.hypot(*left.T), 1e-9)[:, None]
        reach_m = max(14.0, 2.5 * pose.speed_mps)
        share = np.clip(1.0 - (grid - s0) / reach_m, 0.0, 1.0)
        if abs(off) > 0.7:
            way = way + left * (off * share**2 * (3.0 - 2.0 * share))[:, None]
        return pieces, way, s0

    def _idm(self, pose: EgoPose, gap_m: float, speed_mps: float) -> float:
        """Return the acceleration behind an obstacle."""
        speed = pose.speed_mps
        wanted = GAP_M + max(
            0.0, speed * HEADWAY_S + speed * (speed - speed_mps) / (2.0 * math.sqrt(ACCEL * BRAKE))
        )
        gap_m = max(gap_m, 0.1)
        return max(-HARDEST, ACCEL * (1.0 - (wanted / gap_m) ** 2))

    def _stop(self, pose: EgoPose, distance_m: float) -> float:
        """Return the acceleration that stops the front after a distance."""
        distance_m -= LINE_M
        if distance_m <= 0.3:
            return -HARDEST if pose.speed_mps > 0.1 else -1.0
        needed = pose.speed_mps**2 / (2.0 * distance_m)
        if needed >= 0.7 * BRAKE:
            return max(-HARDEST, -needed)
        return min(ACCEL, (distance_m - pose.speed_mps * 1.2) / 2.0)

    def _free(self, speed: float, limit: float) -> float:
        if speed <= limit:
            return ACCEL * (1.0 - (speed / max(limit, 0.1)) ** 4)
        return max(-BRAKE, (limit - speed) / 0.8)

    def _speeds(self, pose: EgoPose, pieces: Sequence[Piece], front_m: float) -> float:
        accel = self._free(pose.speed_mps, pieces[0].lanelet.speed_mps)
        for piece in pieces[1:]:
            accel = min(
                accel, _approach(pose.speed_mps, piece.lanelet.speed_mps, piece.begin_m - front_m)
            )
        return accel

    def _bend(self, pose: EgoPose, points: NDArray[np.float64]) -> float:
        if len(points) < 7:
            return ACCEL
        near, middle, far = points[:-6], points[3:-3], points[6:]
        before, after = middle - near, far - middle
        turn = np.arctan2(
            before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1)
        )
        bend = np.abs(turn) / np.maximum(np.hypot(*(0.5 * (far - near)).T), 1e-6)
        speeds = np.sqrt(BEND_MPS2 / np.maximum(bend, 1e-4))
        return min(
            (
                _approach(pose.speed_mps, float(speed), float(n))
                for n, speed in enumerate(speeds)
                if speed < pose.speed_mps + 3.0
            ),
            default=ACCEL,
        )

    def _gaps(
        self, pose: EgoPose, points: NDArray[np.float64], objects: Sequence[Seen]
    ) -> list[tuple[float, str]]:
        found = []
        for each in objects:
            to = each.place - points[0]
            if np.hypot(*to) > AHEAD_M:
                continue
            outline = _outline(each)
            distance = np.hypot(*(outline[:, None] - points[None]).transpose(2, 0, 1))
            nearest = distance.argmin(axis=1)
            is_on = distance.min(axis=1) < 0.5 * WIDTH_M + BESIDE_M
            # points of an outline beside or behind the vehicle do not count
            is_on &= nearest > 0
            if not is_on.any():
                continue
            first = int(nearest[is_on].min())
            gap_m = first - 0.5 * LENGTH_M
            if gap_m < -1.5:
                continue
            ahead = points[min(first + 1, len(points) - 1)] - points[max(first - 1, 0)]
            course = math.atan2(ahead[1], ahead[0])
            along = each.speed_mps * math.cos(wrapped(each.heading - course))
            found.append((self._idm(pose, gap_m, max(along, 0.0)), "gap"))
        return found

    def _lines(
        self,
        pose: EgoPose,
        pieces: Sequence[Piece],
        front_m: float,
        objects: Sequence[Seen],
        lights: Mapping[int, frozenset[int]],
    ) -> list[tuple[float, str]]:
        """Return accelerations before lines at which the vehicle has to stop, with reasons."""
        found = []
        for n, piece in enumerate(pieces[1:], 1):
            line_m = piece.begin_m - front_m
            if line_m < -1.0 or line_m > SIGHT_M:
                continue
            one = piece.lanelet
            needed = pose.speed_mps**2 / (2.0 * max(line_m - LINE_M, 0.1))
            is_late = needed > 4.0  # too late to stop
            lit = {color for light in one.lights for color in lights.get(light, frozenset())}
            if one.lights and GREEN not in lit and not (lit == {AMBER} and is_late):
                found.append((self._stop(pose, line_m), "light"))
            elif is_late or line_m < 0.0:
                continue
            elif self._must_yield(pose, one, line_m, objects, lights):
                found.append((self._stop(pose, line_m), "yield"))
            elif one.is_turn and not pieces[n - 1].lanelet.is_turn:
                room_m = self._room(pieces, n, objects, front_m)
                if room_m < LENGTH_M + GAP_M:
                    found.append((self._stop(pose, line_m), "room"))
        return found

    def _room(
        self, pieces: Sequence[Piece], n: int, objects: Sequence[Seen], front_m: float
    ) -> float:
        """Return the free length behind the junction that begins with piece n."""
        room_m = math.inf
        for piece in pieces[n:]:
            for each in objects:
                if each.speed_mps > 2.0 or np.hypot(*(each.place - piece.lanelet.centre[0])) > 60.0:
                    continue
                s, off, direction = piece.lanelet.project(each.place)
                if abs(off) > 1.5 or abs(wrapped(direction - each.heading)) > 1.0:
                    continue
                if piece.lanelet.is_turn:
                    return 0.0
                room_m = min(room_m, s - 0.5 * each.length_m)
            if not piece.lanelet.is_turn:
                break
        return room_m

    def _must_yield(
        self,
        pose: EgoPose,
        one: MapLanelet,
        line_m: float,
        objects: Sequence[Seen],
        lights: Mapping[int, frozenset[int]],
    ) -> bool:
        for foe in one.yields_to:
            lit = {color for light in foe.lights for color in lights.get(light, frozenset())}
            is_closed = bool(foe.lights) and not lit & {GREEN, AMBER}
            own_m, foe_m = _crossing(one, foe)
            clear_s = _time_s(pose.speed_mps, max(line_m, 0.0) + own_m + LENGTH_M)
            for each in objects:
                if np.hypot(*(each.place - foe.centre[0])) > SIGHT_M + foe.length_m:
                    continue
                to_m = _distance_to(foe, each, foe_m)
                if to_m is None or (is_closed and to_m > foe_m):
                    continue
                stands = each.speed_mps < 0.5 and to_m > foe_m
                if stands and self._waited_s > PATIENCE_S:
                    continue
                speed = max(each.speed_mps, 3.0 if to_m < foe_m + 12.0 else 1.0)
                if to_m / speed < clear_s + MARGIN_S:
                    return True
        return False


def _direction(heading: float) -> NDArray[np.float64]:
    return np.array([math.cos(heading), math.sin(heading)])


def _outline(each: Seen) -> NDArray[np.float64]:
    """Return points (n, 2) around the body of an object."""
    count = max(3, math.ceil(each.length_m / 1.5) + 1)
    along = np.linspace(-0.5, 0.5, count) * each.length_m
    x = np.repeat(along, 2)
    y = np.tile([-0.5 * each.width_m, 0.5 * each.width_m], count)
    ahead = _direction(each.heading)
    found: NDArray[np.float64] = (
        each.place + x[:, None] * ahead + y[:, None] * np.array([-ahead[1], ahead[0]])
    )
    return found


def _approach(speed: float, limit: float, distance_m: float) -> float:
    """Return the acceleration that reaches a lower speed after a distance."""
    if speed <= limit:
        return ACCEL
    needed = (speed**2 - limit**2) / (2.0 * max(distance_m, 0.5))
    return -min(needed, HARDEST) if needed > 0.6 * BRAKE else ACCEL


def _blocks(lanelet: MapLanelet, s: float, speed: float, each: Seen) -> bool:
    """Return whether an object prevents a change to the lanelet at s."""
    if np.hypot(*(each.place - lanelet.centre[0])) > lanelet.length_m + 30.0:
        return False
    other, off, direction = lanelet.project(each.place)
    if abs(off) > 2.0 or abs(wrapped(direction - each.heading)) > 1.0:
        return False
    gap_m = abs(other - s) - 0.5 * (each.length_m + LENGTH_M)
    closing = each.speed_mps - speed if other < s else speed - each.speed_mps
    return gap_m < 3.0 + 2.0 * max(closing, 0.0) + 0.5 * min(each.speed_mps, speed)


def _crossing(one: MapLanelet, other: MapLanelet) -> tuple[float, float]:
    """Return the positions on two lanelets at which their paths are nearest."""
    distance = np.hypot(*(one.centre[:, None] - other.centre[None]).transpose(2, 0, 1))
    n, m = np.unravel_index(int(distance.argmin()), distance.shape)
    return float(one.along_m[n]), float(other.along_m[m])


def _time_s(speed: float, distance_m: float) -> float:
    """Return the time for a distance with the acceleration `ACCEL`."""
    return (math.sqrt(speed * speed + 2.0 * ACCEL * distance_m) - speed) / ACCEL


def _distance_to(foe: MapLanelet, each: Seen, foe_m: float) -> float | None:
    """Return the distance of an object to the crossing at `foe_m`; None: not on the way there."""
    todo = [(foe, foe_m)]
    seen = set()
    while todo:
        lanelet, ahead_m = todo.pop()
        if lanelet.id in seen or ahead_m - lanelet.length_m > SIGHT_M:
            continue
        seen.add(lanelet.id)
        s, off, direction = lanelet.project(each.place)
        if abs(off) < 1.8 and abs(wrapped(direction - each.heading)) < 0.9:
            left_m = ahead_m - s
            return max(left_m, 0.0) if left_m > -(0.5 * each.length_m + 2.0) else None
        todo += [(before, ahead_m + before.length_m) for before in lanelet.before]
    return None
