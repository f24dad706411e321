"""Lane shapes as POINT rows, without repeated points or segments of zero length."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.math.elementary_arrays import atan2_all, hypot_all
from cavmarl.roads.network import POINT

Shape = NDArray[np.float64]

# SUMO rounds to centimetres, so points at a tenth of that distance are the same.
SAME_POINT_M = 1e-3
# Length of an internal lane whose ends coincide (SUMO joins lanes that meet).
STUB_M = 0.01
CURVE_M = 1.0  # distance between the points of a smooth curve
MOST_POINTS = 24
UNLIKE_M = 3.0  # if a neighbour ends this far from the ends of a lane, the lane gets a point there


def clean_shape(points: Sequence[tuple[float, float, float]]) -> Shape:
    """Drop points that repeat the previous point in the plane; return (n, 3) metres, n ≥ 1.

    Raises MapError: the shape has no points.
    """
    shape: Shape = np.array(points, dtype=np.float64).reshape(-1, 3)
    if not len(shape):
        raise MapError("a lane has no shape: build the network again with netconvert")
    step = hypot_all(*np.diff(shape[:, :2], axis=0).T)
    fresh = np.concatenate([[True], step > SAME_POINT_M])
    return np.ascontiguousarray(shape[fresh])


def refuse_points(shapes: Sequence[Shape], names: Sequence[str]) -> None:
    """Check that lanes outside junctions have a length; `names`: ids of the lanes, for the message.

    Raises MapError: a lane has no length.
    """
    for shape, name in zip(shapes, names, strict=True):
        if len(shape) < 2:
            raise MapError(
                f"lane '{name}' has no length: remove its edge or join its junctions "
                "(netconvert --junctions.join)"
            )


def extend_stubs(shapes: list[Shape], before: Mapping[int, int]) -> None:
    """Extend internal lanes of one point to `STUB_M`, in the direction of the lane before.

    Args:
        shapes: one (n, 3) array per lane row; changed in place.
        before: for each internal row, the row that leads into it; rows of a chain in driving order.
    """
    for row, source in before.items():
        if len(shapes[row]) < 2:
            step = shapes[source][-1] - shapes[source][-2]
            step[2] = 0.0
            shapes[row] = shapes[row][[0, 0]]
            shapes[row][1] += step * (STUB_M / hypot_all(step[0], step[1]))


def split_beside_ends(shapes: list[Shape], outer: Iterable[int]) -> None:
    """Add a point where an adjacent lane begins or ends far from the lane's own ends.

    Then positions between two points correspond linearly to positions on the neighbour.

    Args:
        shapes: one (n, 3) array per lane row; changed in place.
        outer: rows of lanes whose neighbour is the next row.
    """
    for row, beside in ((row + own, row + 1 - own) for row in outer for own in (0, 1)):
        for end in (shapes[beside][0], shapes[beside][-1]):
            shape = shapes[row]
            steps = np.diff(shape, axis=0)
            sizes = hypot_all(steps[:, 0], steps[:, 1])
            along = ((end - shape[:-1])[:, :2] * steps[:, :2]).sum(axis=1) / sizes
            along = np.clip(along, 0.0, sizes)
            places = shape[:-1] + steps * (along / sizes)[:, None]
            k = int(np.argmin(hypot_all(*(places - end)[:, :2].T)))
            before, after = sizes[:k].sum() + along[k], sizes[k:].sum() - along[k]
            if min(before, after) > UNLIKE_M and SAME_POINT_M < along[k] < sizes[k] - SAME_POINT_M:
                shapes[row] = np.insert(shape, k + 1, places[k], axis=0)


def smooth_curve(before: Shape, after: Shape) -> Shape:
    """Return a cubic curve from the end of one lane to the start of another, tangent to both."""
    start, end = before[-1], after[0]
    leaves, arrives = _direction(before[-2:]), _direction(after[:2])
    chord = float(hypot_all(*(end - start)[:2]))
    cos_turn = float(leaves[0] * arrives[0] + leaves[1] * arrives[1])
    # With these control points, the curve is a circular arc if both ends lie on one arc.
    handle = chord * 2.0 / (3.0 * (1.0 + np.sqrt(max(0.5 * (1.0 + cos_turn), 0.0))))
    number = int(np.clip(np.ceil(chord / CURVE_M), 8, MOST_POINTS))
    t = np.linspace(0.0, 1.0, number + 1)[:, None]
    u = 1.0 - t
    curve = (
        u * u * u * start
        + 3.0 * t * u * u * (start + handle * leaves)
        + 3.0 * t * t * u * (end - handle * arrives)
        + t * t * t * end
    )
    s = np.concatenate([[0.0], np.cumsum(hypot_all(*np.diff(curve[:, :2], axis=0).T))])
    curve[:, 2] = start[2] + (end[2] - start[2]) * s / max(s[-1], SAME_POINT_M)  # a constant slope
    return without_repeats(curve)


def _direction(pair: Shape) -> NDArray[np.float64]:
    step = pair[1] - pair[0]
    step[2] = 0.0
    direction: NDArray[np.float64] = step / hypot_all(step[0], step[1])
    return direction


def shape_length(shape: Shape) -> float:
    return float(hypot_all(*np.diff(shape[:, :2], axis=0).T).sum())


def cut_shape(shape: Shape, at_m: float) -> tuple[Shape, Shape]:
    """Return the parts of a polyline before and after a position in m along it."""
    s = np.concatenate([[0.0], np.cumsum(hypot_all(*np.diff(shape[:, :2], axis=0).T))])
    point = np.array([[np.interp(at_m, s, shape[:, axis]) for axis in range(3)]])
    near, far = s < at_m - SAME_POINT_M, s > at_m + SAME_POINT_M
    return np.concatenate([shape[near], point]), np.concatenate([point, shape[far]])


def without_repeats(shape: Shape) -> Shape:
    step = hypot_all(*np.diff(shape[:, :2], axis=0).T)
    return np.ascontiguousarray(shape[np.concatenate([[True], step > SAME_POINT_M])])


def point_rows(shapes: Sequence[Shape]) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """Return the points of all lanes as POINT rows, and each lane's first row plus the end."""
    counts = np.array([len(shape) for shape in shapes])
    first = np.concatenate([[0], np.cumsum(counts)])
    xyz = np.concatenate(shapes)
    delta = np.diff(xyz, axis=0, append=xyz[-1:])
    last = first[1:] - 1
    delta[last] = 0.0
    length = hypot_all(delta[:, 0], delta[:, 1])

    points = np.zeros(len(xyz), POINT)
    points["x"], points["y"], points["z"] = xyz.T
    travelled = np.concatenate([[0.0], np.cumsum(length)[:-1]])
    points["s"] = travelled - np.repeat(travelled[first[:-1]], counts)
    with np.errstate(invalid="ignore"):
        points["cos"] = delta[:, 0] / length
        points["sin"] = delta[:, 1] / length
        points["slope"] = delta[:, 2] / length
    points["heading"] = atan2_all(delta[:, 1], delta[:, 0])
    for name in ("cos", "sin", "slope", "heading"):
        points[name][last] = points[name][last - 1]
    return points, first.astype(np.int32)
