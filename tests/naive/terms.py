"""Compute the time to collision by moving rectangles and comparing their corners."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

HORIZON_S = 4.0
REACH_M = 60.0
LEVEL_M = 4.0
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0

Body = tuple[float, float, float, float, float, float]  # x, y, heading, speed, length, width


def ttc_risk(rows: NDArray[np.void], i: int, larger_m: float = 0.0) -> float:
    """Return 1 - TTC / horizon of the first collision, or 0; boxes grow by `larger_m`."""
    me = rows[i]
    least = HORIZON_S
    for j, other in enumerate(rows):
        distance = math.hypot(other["x"] - me["x"], other["y"] - me["y"])
        if j != i and distance <= REACH_M and abs(other["z"] - me["z"]) <= LEVEL_M:
            least = min(least, time_to_collision_s(_body(me, larger_m), _body(other, larger_m)))
    return 1.0 - least / HORIZON_S


def time_to_collision_s(one: Body, other: Body, horizon_s: float = HORIZON_S) -> float:
    """Return the time until the free distance of two bodies is 0, or inf beyond the horizon.

    If bodies keep their velocities, their free distance is convex in time. It has one minimum, and
    is 0 at most once before the minimum.
    """
    begin, end = 0.0, horizon_s
    for _ in range(60):
        early, late = end - GOLDEN * (end - begin), begin + GOLDEN * (end - begin)
        if free_m(one, other, early) < free_m(one, other, late):
            end = late
        else:
            begin = early
    if free_m(one, other, 0.0) < 0.0:
        return 0.0
    nearest = min((0.0, begin, horizon_s), key=lambda time_s: free_m(one, other, time_s))
    if free_m(one, other, nearest) >= 0.0:
        return math.inf
    apart, touching = 0.0, nearest
    for _ in range(60):
        middle = 0.5 * (apart + touching)
        if free_m(one, other, middle) < 0.0:
            touching = middle
        else:
            apart = middle
    return touching


def free_m(one: Body, other: Body, time_s: float) -> float:
    """Return the widest gap between two bodies along their sides after some time; < 0: overlap."""
    corners = [_corners(body, time_s) for body in (one, other)]
    gaps = []
    for _, _, heading, *_ in (one, other):
        for angle in (heading, heading + 0.5 * math.pi):
            places = [[x * math.cos(angle) + y * math.sin(angle) for x, y in c] for c in corners]
            gaps += [min(places[0]) - max(places[1]), min(places[1]) - max(places[0])]
    return max(gaps)


def _corners(body: Body, time_s: float) -> list[tuple[float, float]]:
    x, y, heading, speed, length, width = body
    ahead = [0.5 * length + speed * time_s, -0.5 * length + speed * time_s]
    return [
        (
            x + along * math.cos(heading) - aside * math.sin(heading),
            y + along * math.sin(heading) + aside * math.cos(heading),
        )
        for along in ahead
        for aside in (0.5 * width, -0.5 * width)
    ]


def _body(row: np.void, larger_m: float) -> Body:
    x, y, heading, speed, length, width = (
        float(row[name]) for name in ("x", "y", "heading", "speed", "length", "width")
    )
    return x, y, heading, speed, length + larger_m, width + larger_m
