"""Partitions of the plane, and points close to their borders."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.zones.partition.zone_partition import Bounds, ZonePartition

BOUNDS: Bounds = (-40.0, -30.0, 60.0, 50.0)

# Five zones around a zone in the middle, so that no straight line separates them.
PINWHEEL = ZonePartition(
    (0.0, 0.0, 30.0, 30.0),
    np.array(
        [[0, 0, 20, 10], [20, 0, 30, 20], [10, 20, 30, 30], [0, 10, 10, 30], [10, 10, 20, 20]],
        dtype=np.float64,
    ),
)


def four(x: float = 10.0, y: float = 20.0) -> ZonePartition:
    """Return four zones that meet at (x, y)."""
    low_x, low_y, high_x, high_y = BOUNDS
    rects = [
        [low_x, low_y, x, y],
        [x, low_y, high_x, y],
        [low_x, y, x, high_y],
        [x, y, high_x, high_y],
    ]
    return ZonePartition(BOUNDS, np.array(rects))


@st.composite
def partitions(draw: st.DrawFn, max_cuts: int = 7) -> ZonePartition:
    """Draw rectangles that are cut repeatedly, often at whole metres, so that four corners meet."""
    if draw(st.integers(0, 9)) == 0:
        return PINWHEEL
    rects = [BOUNDS]
    for _ in range(draw(st.integers(0, max_cuts))):
        rect = rects.pop(draw(st.integers(0, len(rects) - 1)))
        axis = draw(st.integers(0, 1))
        low, high = rect[axis], rect[axis + 2]
        whole = st.integers(int(low) - 1, int(high) + 1).map(float)
        cut = draw(whole | st.floats(low, high))
        if not low < cut < high:
            rects.append(rect)
            continue
        below, above = list(rect), list(rect)
        below[axis + 2] = above[axis] = cut
        rects += [
            (below[0], below[1], below[2], below[3]),
            (above[0], above[1], above[2], above[3]),
        ]
    return ZonePartition(BOUNDS, np.array(draw(st.permutations(rects))))


@st.composite
def places(draw: st.DrawFn, partition: ZonePartition, size: int = 8) -> NDArray[np.float64]:
    """Draw (n, 2) points on borders and corners, close to them, inside, and far outside."""
    columns = []
    for axis in (0, 1):
        sides = np.unique(partition.rects[:, [axis, axis + 2]])
        special = [*sides, *np.nextafter(sides, np.inf), *np.nextafter(sides, -np.inf), 1e7, -1e7]
        anywhere = st.floats(sides[0] - 50.0, sides[-1] + 50.0)
        coordinate = st.sampled_from([float(value) for value in special]) | anywhere
        columns.append(draw(st.lists(coordinate, min_size=size, max_size=size)))
    return np.array(columns).T.copy()
