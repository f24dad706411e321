"""Compute a lidar scan by intersecting each ray with each side of each vehicle."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tests.naive.geometry import Point, box_corners


def lidar(
    rows: NDArray[np.void], row: int, num_rays: int, range_m: float, margin: float = 0.0
) -> list[tuple[float, int]]:
    """Return (distance, id) along each ray; boxes are larger by `margin` on each side."""
    ego = rows[row]
    scan = []
    for ray in range(num_rays):
        angle = ego["heading"] + 2.0 * math.pi * ray / num_rays
        direction = (math.cos(angle), math.sin(angle))
        best = (range_m, -1)
        for i, other in enumerate(rows):
            if i == row or abs(other["z"] - ego["z"]) > 4.0:
                continue
            corners = box_corners(
                other["x"] - ego["x"],
                other["y"] - ego["y"],
                other["heading"],
                0.5 * other["length"] + margin,
                0.5 * other["width"] + margin,
            )
            distance = ray_to_polygon(direction, corners)
            if distance < range_m:
                best = min(best, (distance, int(other["id"])))
        scan.append(best)
    return scan


def ray_to_polygon(direction: Point, corners: list[Point]) -> float:
    """Return the distance along a unit vector to a convex counter-clockwise polygon."""
    sides = list(pairwise([*corners, corners[0]]))
    if all(a[0] * b[1] - b[0] * a[1] >= 0.0 for a, b in sides):
        return 0.0
    return min(_ray_to_side(direction, a, b) for a, b in sides)


def _ray_to_side(direction: Point, a: Point, b: Point) -> float:
    edge = (b[0] - a[0], b[1] - a[1])
    slant = direction[0] * edge[1] - direction[1] * edge[0]
    if abs(slant) < 1e-12:
        return math.inf  # the ray is parallel to this side, so the adjacent sides decide
    distance = (a[0] * edge[1] - a[1] * edge[0]) / slant
    share = (a[0] * direction[1] - a[1] * direction[0]) / slant
    return distance if distance >= 0.0 and 0.0 <= share <= 1.0 else math.inf
