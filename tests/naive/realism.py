"""The realism meta-metric in plain Python, written from its definition, one number at a time.

Unlike the package, this code computes distances between bodies from Minkowski differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

Point = tuple[float, float]
Pose = tuple[float, float, float]

NONE_M = 1e10


class Body(NamedTuple):
    """The poses of an object over time (None while it is absent), its length and its width."""

    poses: Sequence[Pose | None]
    length: float
    width: float


HISTOGRAMS = {
    "linear_speed": (0.0, 25.0, 10),
    "linear_acceleration": (-12.0, 12.0, 11),
    "angular_speed": (-0.628, 0.628, 11),
    "angular_acceleration": (-3.14, 3.14, 11),
    "distance_to_nearest_object": (-5.0, 40.0, 10),
    "time_to_collision": (0.0, 5.0, 10),
    "distance_to_road_edge": (-20.0, 40.0, 10),
}
WEIGHTS = {
    "linear_speed": 0.05,
    "linear_acceleration": 0.05,
    "angular_speed": 0.05,
    "angular_acceleration": 0.05,
    "distance_to_nearest_object": 0.1,
    "collision_indication": 0.25,
    "time_to_collision": 0.1,
    "distance_to_road_edge": 0.1,
    "offroad_indication": 0.25,
}


def corners(pose: Pose, length: float, width: float) -> list[Point]:
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    return [
        (x + u * cos - v * sin, y + u * sin + v * cos)
        for u, v in (
            (length / 2, -width / 2),
            (length / 2, width / 2),
            (-length / 2, width / 2),
            (-length / 2, -width / 2),
        )
    ]


def _cross(o: Point, a: Point, b: Point) -> float:
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


def hull(points: list[Point]) -> list[Point]:
    """Return the convex hull, counter-clockwise."""
    points = sorted(set(points))
    halves: list[list[Point]] = []
    for ordered in (points, points[::-1]):
        half: list[Point] = []
        for point in ordered:
            while len(half) > 1 and _cross(half[-2], half[-1], point) <= 1e-12:
                half.pop()
            half.append(point)
        halves.append(half[:-1])
    return halves[0] + halves[1]


def to_segment(point: Point, start: Point, end: Point) -> float:
    east, north = end[0] - start[0], end[1] - start[1]
    square = east * east + north * north
    share = ((point[0] - start[0]) * east + (point[1] - start[1]) * north) / square
    share = min(max(share, 0.0), 1.0)
    return math.hypot(point[0] - start[0] - share * east, point[1] - start[1] - share * north)


def body_distance(one: list[Point], other: list[Point]) -> float:
    """Return the signed distance of two convex bodies, from their Minkowski difference."""
    shape = hull([(a[0] - b[0], a[1] - b[1]) for a in one for b in other])
    sides = list(zip(shape, shape[1:] + shape[:1], strict=True))
    nearest = min(to_segment((0.0, 0.0), a, b) for a, b in sides)
    return -nearest if all(_cross(a, b, (0.0, 0.0)) > 0.0 for a, b in sides) else nearest


def object_distance(one: tuple[Pose, float, float], other: tuple[Pose, float, float]) -> float:
    """Return the signed distance of two objects (pose, length, width) with round corners."""
    cores, radii = [], 0.0
    for pose, length, width in (one, other):
        radius = 0.7 * min(length, width) / 2
        cores.append(corners(pose, length - 2 * radius, width - 2 * radius))
        radii += radius
    return body_distance(cores[0], cores[1]) - radii


def edge_distance(point: Point, lines: Sequence[Sequence[Point]]) -> float:
    """Return the signed distance to the nearest line, positive on its right."""
    best = NONE_M
    for line in lines:
        found = _line_distance(point, line)
        if abs(found) < abs(best):
            best = found
    return best


def _line_distance(point: Point, line: Sequence[Point]) -> float:
    parts = list(pairwise(line))
    is_ring = math.dist(line[0], line[-1]) < 1.0
    apart = [to_segment(point, a, b) for a, b in parts]
    k = apart.index(min(apart))

    def side(number: int) -> float:  # 1 on the right
        a, b = parts[number]
        value = _cross(a, b, point)
        return 0.0 if value == 0.0 else -math.copysign(1.0, value)

    a, b = parts[k]
    share = (point[0] - a[0]) * (b[0] - a[0]) + (point[1] - a[1]) * (b[1] - a[1])
    share /= (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2
    sign = side(k)
    if share < 0.0 or share >= 1.0:
        before, after = (k - 1, k) if share < 0.0 else (k, k + 1)
        other = before if share < 0.0 else after
        if not is_ring and not 0 <= other < len(parts):
            neighbour = sign
        else:
            neighbour = side(other % len(parts))
        (p, q), (r, s) = parts[before % len(parts)], parts[after % len(parts)]
        turn = (q[0] - p[0]) * (s[1] - r[1]) - (q[1] - p[1]) * (s[0] - r[0])
        sign = max(sign, neighbour) if turn > 0.0 else min(sign, neighbour)
    return sign * apart[k]


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def series(
    bodies: Sequence[Body], k: int, lines: Sequence[Sequence[Point]], step_s: float
) -> dict[str, list[float | None]]:
    """Return the features of body k at each time; None stands for no value."""
    own = bodies[k]
    times = range(len(own.poses))

    def speed_of(body: Body, t: int) -> float | None:
        if not 0 < t < len(body.poses) - 1:
            return None
        before, after = body.poses[t - 1], body.poses[t + 1]
        if before is None or after is None:
            return None
        return math.hypot(after[0] - before[0], after[1] - before[1]) / 2.0 / step_s

    def turn_of(t: int) -> float | None:
        if not 0 < t < len(own.poses) - 1:
            return None
        before, after = own.poses[t - 1], own.poses[t + 1]
        if before is None or after is None:
            return None
        return _wrapped(after[2] - before[2]) / 2.0

    found: dict[str, list[float | None]] = {name: [] for name in (*HISTOGRAMS, "hit", "off")}
    for t in times:
        before, after = (speed_of(own, t - 1), speed_of(own, t + 1))
        turns = turn_of(t - 1), turn_of(t + 1)
        turn = turn_of(t)
        found["linear_speed"].append(speed_of(own, t))
        found["linear_acceleration"].append(
            None if before is None or after is None else (after - before) / 2.0 / step_s
        )
        found["angular_speed"].append(None if turn is None else turn / step_s)
        found["angular_acceleration"].append(
            None
            if turns[0] is None or turns[1] is None
            else _wrapped(turns[1] - turns[0]) / 2.0 / step_s**2
        )
        pose = own.poses[t]
        if pose is None:
            for name in ("distance_to_nearest_object", "time_to_collision", "distance_to_road_edge",
                         "hit", "off"):  # fmt: skip
                found[name].append(None)
            continue
        box = corners(pose, own.length, own.width)
        others = [
            (body, there)
            for n, body in enumerate(bodies)
            if n != k and (there := body.poses[t]) is not None
        ]
        nearest = min(
            (
                object_distance((pose, own.length, own.width), (there, body.length, body.width))
                for body, there in others
            ),
            default=NONE_M,
        )
        edge = max(edge_distance(corner, lines) for corner in box)
        found["distance_to_nearest_object"].append(nearest)
        found["distance_to_road_edge"].append(edge)
        found["hit"].append(float(nearest < 0.0))
        found["off"].append(float(edge > 0.0))
        found["time_to_collision"].append(
            _ttc(own, pose, [(body, there, speed_of(body, t)) for body, there in others],
                 speed_of(own, t))
        )  # fmt: skip
    return found


def _ttc(
    own: Body, pose: Pose, others: list[tuple[Body, Pose, float | None]], speed: float | None
) -> float:
    """Return the time until body `own` reaches the nearest body that it follows."""
    best_m, best_speed = math.inf, None
    for body, there, its_speed in others:
        turned = abs(there[2] - pose[2])
        box = corners((0.0, 0.0, turned), body.length, body.width)
        long, wide = max(x for x, _ in box), max(y for _, y in box)
        east, north = there[0] - pose[0], there[1] - pose[1]
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        ahead = east * cos + north * sin - own.length / 2 - long
        beside = abs(north * cos - east * sin) - own.width / 2 - wide
        if ahead <= 0.0 or turned > math.radians(75.0) or beside >= 0.0:
            continue
        if beside >= -0.5 and turned > math.radians(10.0):
            continue
        if ahead < best_m:
            best_m, best_speed = ahead, its_speed
    if speed is None or best_speed is None or speed <= best_speed:
        return 5.0
    return min(best_m / (speed - best_speed), 5.0)


def likelihoods(
    log: Sequence[Body],
    rollouts: Sequence[Sequence[Body]],
    evaluated: int,
    lines: Sequence[Sequence[Point]],
    step_s: float,
    first: int,
) -> dict[str, float]:
    """Return the likelihood of each component, and `meta`, their weighted sum."""
    logged = [series(log, k, lines, step_s) for k in range(evaluated)]
    drawn = [[series(one, k, lines, step_s) for k in range(evaluated)] for one in rollouts]
    found = {}
    for name, (low, high, bins) in HISTOGRAMS.items():

        def bin_of(value: float, low: float = low, high: float = high, bins: int = bins) -> int:
            share = (min(max(value, low), high) - low) / (high - low)
            return min(int(share * bins), bins - 1)

        logs = []
        for k in range(evaluated):
            counts = [0.1] * bins
            for one in drawn:
                for value in one[k][name][first:]:
                    if value is not None:
                        counts[bin_of(value)] += 1.0
            for value in logged[k][name][first:]:
                if value is not None:
                    logs.append(math.log(counts[bin_of(value)] / sum(counts)))
        found[name] = math.exp(sum(logs) / len(logs))
    for name, key in (("collision_indication", "hit"), ("offroad_indication", "off")):
        logs = []
        for k in range(evaluated):
            seen = [t for t in range(first, len(log[k].poses)) if log[k].poses[t] is not None]
            happened = any(logged[k][key][t] for t in seen)
            same = sum(any(one[k][key][t] for t in seen) == happened for one in drawn)
            logs.append(math.log((same + 0.001) / (len(drawn) + 0.002)))
        found[name] = math.exp(sum(logs) / len(logs))
    found["meta"] = sum(WEIGHTS[name] * found[name] for name in WEIGHTS)
    return found
