"""Plane geometry, computed by the simplest correct method."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float]


def wrap_angle(angle: float) -> float:
    """Return the IEEE remainder of an angle, with -π replaced by π."""
    wrapped = math.remainder(angle, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


def lane_pose(corners: NDArray[np.float64], s: float) -> tuple[float, ...]:
    """Return the pose at `s` along (n, 3) corners; the last segment continues beyond its end."""
    left = s
    for i in range(len(corners) - 1):
        step = corners[i + 1] - corners[i]
        length = math.hypot(step[0], step[1])
        if left < length or i == len(corners) - 2:
            break
        left -= length
    unit = step / length
    return (*(corners[i] + left * unit), *unit)


def nearest_on_polyline(corners: NDArray[np.float64], x: float, y: float) -> tuple[float, float]:
    """Return the distance to the polyline (n, 2) and the arc length of its nearest point."""
    best = (math.inf, 0.0)
    start = 0.0
    for a, b in pairwise(corners):
        length = math.hypot(*(b - a))
        unit = (b - a) / length
        along = min(max((np.array([x, y]) - a) @ unit, 0.0), length)
        distance = math.hypot(*(np.array([x, y]) - (a + along * unit)))
        best = min(best, (distance, start + along))
        start += length
    return best


def box_corners(
    x: float, y: float, heading: float, half_length: float, half_width: float
) -> list[Point]:
    """Return the corners of a box, counter-clockwise from the front left."""
    cos, sin = math.cos(heading), math.sin(heading)
    return [
        (x + a * cos - b * sin, y + a * sin + b * cos)
        for a, b in (
            (half_length, half_width),
            (-half_length, half_width),
            (-half_length, -half_width),
            (half_length, -half_width),
        )
    ]


def common_area(one: list[Point], other: list[Point]) -> float:
    """Return the common area of two convex counter-clockwise polygons, by clipping."""
    shape = one
    for i, a in enumerate(other):
        shape = _clip(shape, a, other[(i + 1) % len(other)])
    around = pairwise([*shape, *shape[:1]])
    return 0.5 * sum(p[0] * q[1] - q[0] * p[1] for p, q in around)


def _clip(shape: list[Point], a: Point, b: Point) -> list[Point]:
    """Return the part of `shape` to the left of the line from a to b."""

    def side(p: Point) -> float:
        return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])

    kept: list[Point] = []
    for i, p in enumerate(shape):
        q = shape[(i + 1) % len(shape)]
        if side(p) >= 0.0:
            kept.append(p)
        if (side(p) > 0.0) != (side(q) > 0.0) and side(p) != side(q):
            share = side(p) / (side(p) - side(q))
            kept.append((p[0] + share * (q[0] - p[0]), p[1] + share * (q[1] - p[1])))
    return kept
