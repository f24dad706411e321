"""Find zones by checking each rectangle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def owners(rects: NDArray[np.float64], x: float, y: float) -> list[int]:
    """Return the zones whose half-open rectangle contains the point; one zone in a partition."""
    return [
        zone
        for zone, (min_x, min_y, max_x, max_y) in enumerate(rects.tolist())
        if min_x <= x < max_x and min_y <= y < max_y
    ]


def distance(rect: NDArray[np.float64], x: float, y: float) -> float:
    """Return the distance from a point to a rectangle."""
    min_x, min_y, max_x, max_y = rect.tolist()
    return math.hypot(x - min(max(x, min_x), max_x), y - min(max(y, min_y), max_y))


def within(rect: NDArray[np.float64], distance_m: float, rows: Sequence[np.void]) -> list[np.void]:
    """Return the rows within a distance of a rectangle."""
    found = []
    for row in rows:
        dx = max(rect[0] - row["x"], row["x"] - rect[2], 0.0)
        dy = max(rect[1] - row["y"], row["y"] - rect[3], 0.0)
        # Compare squared distances as the kernel does, because a root would round again.
        if dx * dx + dy * dy <= distance_m * distance_m:
            found.append(row)
    return found


def published(
    rects: NDArray[np.float64], halo_m: float, xy: NDArray[np.float64], zone: int
) -> list[list[int]]:
    """Return, for each zone, the rows of `xy` (owned by `zone`) that are within its halo."""
    needed: list[list[int]] = []
    for other, rect in enumerate(rects.tolist()):
        rows = []
        for row, (x, y) in enumerate(xy.tolist()):
            dx = max(rect[0] - x, x - rect[2], 0.0)
            dy = max(rect[1] - y, y - rect[3], 0.0)
            # Compare squared distances as the kernel does, because a root would round again.
            if other != zone and dx * dx + dy * dy <= halo_m * halo_m:
                rows.append(row)
        needed.append(rows)
    return needed


def near_borders(
    rects: NDArray[np.float64],
    zone: int,
    hysteresis_m: float,
    ahead_s: float,
    rows: NDArray[np.void],
) -> list[tuple[int, int, bool]]:
    """Return (row, other zone, whether it has crossed) of the vehicles near borders."""
    found = []
    for i, row in enumerate(rows):
        here = zone
        if distance(rects[zone], row["x"], row["y"]) > hysteresis_m:
            (here,) = owners(rects, row["x"], row["y"])
            found.append((i, here, True))
        way = row["speed"] * ahead_s
        x = row["x"] + math.cos(row["heading"]) * way
        y = row["y"] + math.sin(row["heading"]) * way
        if distance(rects[zone], x, y) > hysteresis_m:
            (there,) = owners(rects, x, y)
            if there != here:
                found.append((i, there, False))
    return found
