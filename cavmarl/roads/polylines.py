"""Lane shapes as POINT rows: no repeated points, no segment without a direction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.roads.network import POINT

Shape = NDArray[np.float64]

# SUMO writes centimetres: two points nearer than a tenth of that are one.
SAME_POINT_M = 1e-3
# The length of an internal lane whose two ends are the same point (SUMO joins lanes that meet).
STUB_M = 0.01


def clean_shape(points: Sequence[tuple[float, float, float]]) -> Shape:
    """Drop points that repeat the one before in the plane; (n, 3) metres, n ≥ 1.

    Raises MapError: the shape has no points.
    """
    shape: Shape = np.array(points, dtype=np.float64).reshape(-1, 3)
    if not len(shape):
        raise MapError("a lane has no shape: build the network again with netconvert")
    step = np.hypot(*np.diff(shape[:, :2], axis=0).T)
    fresh = np.concatenate([[True], step > SAME_POINT_M])
    return np.ascontiguousarray(shape[fresh])


def refuse_points(shapes: Sequence[Shape], names: Sequence[str]) -> None:
    """Check that normal lanes, with their ids for the message, have a length.

    Raises MapError: one has none.
    """
    for shape, name in zip(shapes, names, strict=True):
        if len(shape) < 2:
            raise MapError(
                f"lane '{name}' has no length: remove its edge or join its junctions "
                "(netconvert --junctions.join)"
            )


def extend_stubs(shapes: list[Shape], before: Mapping[int, int]) -> None:
    """Stretch internal lanes of one point to `STUB_M`, in the direction they are entered.

    Args:
        shapes: one (n, 3) array a lane row; changed in place.
        before: the row that leads into an internal row; rows of a chain in driving order.
    """
    for row, source in before.items():
        if len(shapes[row]) < 2:
            step = shapes[source][-1] - shapes[source][-2]
            step[2] = 0.0
            shapes[row] = shapes[row][[0, 0]]
            shapes[row][1] += step * (STUB_M / np.hypot(step[0], step[1]))


def point_rows(shapes: Sequence[Shape]) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """All lanes' points as POINT rows, and each lane's first row with the end as last entry."""
    counts = np.array([len(shape) for shape in shapes])
    first = np.concatenate([[0], np.cumsum(counts)])
    xyz = np.concatenate(shapes)
    delta = np.diff(xyz, axis=0, append=xyz[-1:])
    last = first[1:] - 1
    delta[last] = 0.0
    length = np.hypot(delta[:, 0], delta[:, 1])

    points = np.zeros(len(xyz), POINT)
    points["x"], points["y"], points["z"] = xyz.T
    travelled = np.concatenate([[0.0], np.cumsum(length)[:-1]])
    points["s"] = travelled - np.repeat(travelled[first[:-1]], counts)
    with np.errstate(invalid="ignore"):
        points["cos"] = delta[:, 0] / length
        points["sin"] = delta[:, 1] / length
        points["slope"] = delta[:, 2] / length
    points["heading"] = np.arctan2(delta[:, 1], delta[:, 0])
    for name in ("cos", "sin", "slope", "heading"):
        points[name][last] = points[name][last - 1]
    return points, first.astype(np.int32)
