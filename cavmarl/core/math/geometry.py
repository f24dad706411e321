"""Plane geometry: angles, positions on polylines, overlap of oriented boxes.

Polylines are POINT records `points[first : first + num]` of `roads.network`, at least two. The end
segments count as infinitely long, so positions slightly before the start or beyond the end have
coordinates, too. Metres and radians; `d` is positive to the left of the driving direction.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel

STILL_MPS = 1e-9  # slower relative motion counts as none

PI = math.pi
TWO_PI = 2.0 * math.pi


@kernel
def wrap_angle(angle: float) -> float:
    """Return the same direction in (-pi, pi], for any finite angle in radians."""
    if -PI < angle <= PI:
        return angle
    wrapped = angle % TWO_PI
    return wrapped - TWO_PI if wrapped > PI else wrapped


@kernel
def segment_at(points: NDArray[np.void], first: int, num: int, s: float) -> int:
    """Return the POINT row of the last segment that starts at or before `s`; the first if s < 0."""
    low = first
    high = first + num - 2
    while low < high:
        middle = (low + high + 1) // 2
        if points[middle]["s"] <= s:
            low = middle
        else:
            high = middle - 1
    return low


@kernel
def lane_pose(
    points: NDArray[np.void],  # POINT (num_points,)
    first: int,  # row of the polyline's first point
    num: int,  # points of the polyline, at least 2
    s: float,  # m; the end segments extend straight on
) -> tuple[float, float, float, float, float, float]:
    """Return the position and direction at arc length `s` of a polyline.

    Returns:
        x, y, z in metres, cos and sin of the direction, slope dz/ds.
    """
    point = points[segment_at(points, first, num, s)]
    along = s - point["s"]
    return (
        point["x"] + along * point["cos"],
        point["y"] + along * point["sin"],
        point["z"] + along * point["slope"],
        point["cos"],
        point["sin"],
        point["slope"],
    )


@kernel
def _nearest_segment(
    points: NDArray[np.void], start: int, stop: int, x: float, y: float
) -> tuple[int, float]:
    """Return the POINT row of the first nearest segment in [start, stop), and the distance²."""
    nearest = start
    smallest = np.inf
    for i in range(start, stop):
        point = points[i]
        dx = x - point["x"]
        dy = y - point["y"]
        along = dx * point["cos"] + dy * point["sin"]
        across = dy * point["cos"] - dx * point["sin"]
        length = points[i + 1]["s"] - point["s"]
        beyond = max(along - length, -along, 0.0)
        squared = across * across + beyond * beyond
        if squared < smallest:
            smallest = squared
            nearest = i
    return nearest, smallest


@kernel
def _left_of(point: np.void, x: float, y: float) -> float:
    """Return the signed distance of a point to a segment's line, positive to the left."""
    offset: float = (y - point["y"]) * point["cos"] - (x - point["x"]) * point["sin"]
    return offset


@kernel
def _project_between(
    points: NDArray[np.void], first: int, num: int, start: int, stop: int, x: float, y: float
) -> tuple[float, float, float, float]:
    """Return the result of `project` for the segments [start, stop) only."""
    nearest, squared = _nearest_segment(points, start, stop, x, y)
    point = points[nearest]
    along = (x - point["x"]) * point["cos"] + (y - point["y"]) * point["sin"]
    length = points[nearest + 1]["s"] - point["s"]
    d = _left_of(point, x, y)
    if along < 0.0 and nearest > first:
        # The nearest point is a corner. In a sharp bend, the side depends on both segments.
        side = d + _left_of(points[nearest - 1], x, y)
        along = 0.0
        d = math.copysign(math.sqrt(squared), side)
    elif along > length and nearest < first + num - 2:
        side = d + _left_of(points[nearest + 1], x, y)
        along = length
        d = math.copysign(math.sqrt(squared), side)
    return point["s"] + along, d, point["cos"], point["sin"]


@kernel
def project(
    points: NDArray[np.void],  # POINT (num_points,)
    first: int,  # row of the polyline's first point
    num: int,  # points of the polyline, at least 2
    x: float,  # m
    y: float,  # m
) -> tuple[float, float, float, float]:  # s and d in metres, cos and sin of the direction there
    """Return the lane coordinates of a point, relative to the nearest point of the polyline.

    Of several nearest points, the point with the smallest `s` counts. If it is an end of the
    polyline, `s` and `d` are relative to the end segment's line, so `s` may be outside of [0,
    length].
    """
    return _project_between(points, first, num, first, first + num - 1, x, y)


@kernel
def project_near(
    points: NDArray[np.void],
    first: int,
    num: int,
    x: float,
    y: float,
    s_hint: float,
    window_m: float,
) -> tuple[float, float, float, float]:
    """Project onto segments that overlap [s_hint - window_m, s_hint + window_m]; see `project`.

    Faster on long lanes, and it keeps a vehicle on its branch of a lane that returns to itself.
    """
    start = segment_at(points, first, num, s_hint - window_m)
    stop = segment_at(points, first, num, s_hint + window_m) + 1
    return _project_between(points, first, num, start, stop, x, y)


@kernel
def boxes_overlap(
    x1: float,  # centre of the first box, m
    y1: float,  # centre of the first box, m
    cos1: float,  # cos of the heading
    sin1: float,  # sin of the heading
    half_length1: float,  # along its heading, m
    half_width1: float,  # across its heading, m
    x2: float,  # centre of the second box, m
    y2: float,  # centre of the second box, m
    cos2: float,  # as above
    sin2: float,  # as above
    half_length2: float,  # as above
    half_width2: float,  # as above
) -> bool:
    """Return whether two oriented rectangles share area; touching does not count.

    Separating axes (Gottschalk, Lin, Manocha: "OBBTree", SIGGRAPH 1996), in the plane. Swapping the
    boxes swaps the comparisons and does not change a bit.
    """
    dx = x2 - x1
    dy = y2 - y1
    cos = abs(cos1 * cos2 + sin1 * sin2)
    sin = abs(cos1 * sin2 - sin1 * cos2)
    return (
        abs(dx * cos1 + dy * sin1) < half_length1 + half_length2 * cos + half_width2 * sin
        and abs(dy * cos1 - dx * sin1) < half_width1 + half_length2 * sin + half_width2 * cos
        and abs(dx * cos2 + dy * sin2) < half_length2 + half_length1 * cos + half_width1 * sin
        and abs(dy * cos2 - dx * sin2) < half_width2 + half_length1 * sin + half_width1 * cos
    )


@kernel
def _overlap_s(apart: float, rate: float, reach: float) -> tuple[float, float]:
    """Return when two projections start and stop overlapping on one axis, in s; inf, -inf: never.

    Their centres are `apart` m apart, which changes by `rate` m/s.
    """
    if abs(rate) < STILL_MPS:
        return (-math.inf, math.inf) if abs(apart) < reach else (math.inf, -math.inf)
    return (
        min((-reach - apart) / rate, (reach - apart) / rate),
        max((-reach - apart) / rate, (reach - apart) / rate),
    )


@kernel
def time_to_collision_s(
    dx: float,  # from the first box's centre to the second box's centre, m
    dy: float,  # see `dx`
    vx: float,  # velocity of the second box relative to the first box, m/s
    vy: float,  # see `vx`
    cos1: float,  # cos of the first box's heading
    sin1: float,  # see `cos1`
    half_length1: float,  # along its heading, m
    half_width1: float,  # across its heading, m
    cos2: float,  # as above, for the second box
    sin2: float,  # as above
    half_length2: float,  # as above
    half_width2: float,  # as above
) -> float:
    """Return the time in s until two oriented rectangles touch; inf: never, 0: now.

    This is Hayward's time to collision ("Near miss determination through use of a scale of danger",
    Highway Research Record 384, 1972) for bodies with constant velocities that do not turn. Two
    bodies overlap while their projections overlap on all four axes of `boxes_overlap`.
    """
    cos = abs(cos1 * cos2 + sin1 * sin2)
    sin = abs(cos1 * sin2 - sin1 * cos2)
    # Across the first box first: most nearby vehicles pass on another lane.
    reach = half_width1 + half_length2 * sin + half_width2 * cos
    begin, end = _overlap_s(dy * cos1 - dx * sin1, vy * cos1 - vx * sin1, reach)
    if end <= 0.0:
        return math.inf
    reach = half_length1 + half_length2 * cos + half_width2 * sin
    first, last = _overlap_s(dx * cos1 + dy * sin1, vx * cos1 + vy * sin1, reach)
    begin, end = max(begin, first), min(end, last)
    if begin >= end:
        return math.inf
    reach = half_length2 + half_length1 * cos + half_width1 * sin
    first, last = _overlap_s(dx * cos2 + dy * sin2, vx * cos2 + vy * sin2, reach)
    begin, end = max(begin, first), min(end, last)
    reach = half_width2 + half_length1 * sin + half_width1 * cos
    first, last = _overlap_s(dy * cos2 - dx * sin2, vy * cos2 - vx * sin2, reach)
    begin, end = max(begin, first, 0.0), min(end, last)
    return begin if begin < end else math.inf
