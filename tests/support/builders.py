"""Polylines and vehicles for tests of kernels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.driving.vehicles import VEHICLE
from cavmarl.roads.network import POINT


def coordinates(size_m: float) -> st.SearchStrategy[float]:
    """Draw coordinates up to `size_m`, often whole metres, to produce ties and contacts."""
    whole = st.integers(-int(size_m), int(size_m)).map(float)
    return whole | st.floats(-size_m, size_m)


def angles() -> st.SearchStrategy[float]:
    """Draw headings in (-pi, pi], often right angles."""
    right = st.sampled_from([-0.5 * np.pi, 0.0, 0.5 * np.pi, np.pi])
    return right | st.floats(-np.pi, np.pi, exclude_min=True)


def points_of(corners: NDArray[np.float64]) -> NDArray[np.void]:
    """Return POINT records of a polyline with (n, 3) corners."""
    steps = np.diff(corners, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    points = np.zeros(len(corners), POINT)
    points["x"], points["y"], points["z"] = corners.T
    points["s"][1:] = np.cumsum(lengths)
    for field, values in (("cos", steps[:, 0]), ("sin", steps[:, 1]), ("slope", steps[:, 2])):
        points[field][:-1] = values / lengths
        points[field][-1] = points[field][-2]
    return points


@st.composite
def polylines(draw: st.DrawFn) -> NDArray[np.float64]:
    """Draw (n, 3) corners, at least 1 m apart."""
    corner = st.tuples(coordinates(50.0), coordinates(50.0), st.floats(-5.0, 5.0))
    corners = [np.array(draw(corner))]
    for step in draw(st.lists(corner, min_size=1, max_size=5)):
        if np.hypot(step[0], step[1]) >= 1.0:
            corners.append(corners[-1] + np.array(step))
    if len(corners) == 1:
        corners.append(corners[0] + np.array([7.0, 0.0, 1.0]))
    return np.stack(corners)


def vehicles(places: Sequence[tuple[float, ...]], **fields: object) -> NDArray[np.void]:
    """Return cars of 5 m by 2 m by 1.5 m at (x, y, heading), sorted by id; `fields` set columns."""
    rows = np.zeros(len(places), VEHICLE)
    rows["id"] = np.arange(len(places))
    rows["length"], rows["width"], rows["height"] = 5.0, 2.0, 1.5
    for row, (x, y, heading) in zip(rows, places, strict=True):
        row["x"], row["y"], row["heading"] = x, y, heading
    for field, values in fields.items():
        rows[field] = values
    return rows


@st.composite
def crowds(draw: st.DrawFn, most: int = 12, size_m: float = 30.0) -> NDArray[np.void]:
    """Draw cars and trucks in random order of ids, on two levels, often overlapping."""
    place = st.tuples(coordinates(size_m), coordinates(size_m), angles())
    rows = vehicles(draw(st.lists(place, min_size=1, max_size=most)))
    num = len(rows)
    rows["id"] = draw(st.permutations(range(10, 10 + num)))
    rows["z"] = draw(st.lists(st.sampled_from([0.0, 1.0, 6.0]), min_size=num, max_size=num))
    rows["length"] = draw(st.lists(st.sampled_from([4.0, 5.0, 18.0]), min_size=num, max_size=num))
    rows["speed"] = draw(st.lists(st.floats(-5.0, 30.0), min_size=num, max_size=num))
    return rows
