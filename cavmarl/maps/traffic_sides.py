"""The side of the road on which vehicles drive, by place."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary_arrays import cos_all

Side = Literal["left", "right"]

NEAR_M = 3_000.0  # distance from a border within which the areas are too inaccurate
_CELLS_PER_DEGREE = 200.0  # places are rounded to cells of about 500 m
_M_PER_DEGREE = 111_195.0


def sides_at(places: Iterable[tuple[float, float]]) -> set[Side]:
    """Return the traffic sides at (longitude, latitude) places in degrees.

    Places within `NEAR_M` of a border between both sides do not count, so the result may be empty.
    """
    points = np.array(list(places), dtype=np.float64).reshape(-1, 2)
    cells = np.unique(np.round(points * _CELLS_PER_DEGREE), axis=0) / _CELLS_PER_DEGREE
    inside = np.zeros(len(cells), dtype=np.bool_)
    far = np.ones(len(cells), dtype=np.bool_)
    for ring in _rings():
        # Skip far rings: most places are far from most rings.
        low, high = ring.min(axis=0) - 0.2, ring.max(axis=0) + 0.2
        rows = np.flatnonzero(((cells >= low) & (cells <= high)).all(axis=1))
        for row in rows.tolist():
            inside[row] ^= _is_inside(ring, cells[row])
            far[row] &= _distance_m(ring, cells[row]) > NEAR_M
    found: set[Side] = set()
    if (inside & far).any():
        found.add("left")
    if (~inside & far).any():
        found.add("right")
    return found


@cache
def _rings() -> tuple[NDArray[np.float64], ...]:
    """Return the borders of areas with left-hand traffic: (n, 2) longitude, latitude in degrees."""
    text = (files("cavmarl.maps") / "left_hand.txt").read_text(encoding="utf-8")
    return tuple(
        np.array([point.split(",") for point in line.split()], dtype=np.float64) / 100.0
        for line in text.splitlines()
        if not line.startswith("#")
    )


def _is_inside(ring: NDArray[np.float64], point: NDArray[np.float64]) -> bool:
    x, y = (ring - point).T
    next_x, next_y = np.roll(x, -1), np.roll(y, -1)
    crosses = (y > 0.0) != (next_y > 0.0)
    to_the_east = (x * next_y - next_x * y > 0.0) == (next_y > y)
    return bool((crosses & to_the_east).sum() % 2)


def _distance_m(ring: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    """Return the distance of a point from a ring in the plane around that point."""
    shrink = float(cos_all(np.radians(point[1:]))[0])
    start = (ring - point) * (shrink * _M_PER_DEGREE, _M_PER_DEGREE)
    step = np.roll(start, -1, axis=0) - start
    square = np.maximum((step * step).sum(axis=1), 1e-9)
    share = np.clip(-(start * step).sum(axis=1) / square, 0.0, 1.0)
    nearest = start + share[:, None] * step
    return float(np.sqrt((nearest * nearest).sum(axis=1).min()))
