"""Bodies, walls, mounts and scenes for tests of rays and pictures."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import Grid, fill_grid, make_grid
from cavmarl.roads.kernels.backdrop_pieces import WALL, Backdrop
from cavmarl.sensors.kernels.panorama import (
    CAR,
    PEDESTRIAN,
    Counts,
    Panorama,
    gather,
    make_panorama,
)
from tests.naive.imaging import turn
from tests.support.builders import coordinates

NO_WALLS = np.zeros(0, WALL)
RIGHT = 0.5 * math.pi


def mount(
    place: tuple[float, float, float] = (0.0, 0.0, 1.0),
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> NDArray[np.float64]:
    """Return (3, 4) axes and position of a sensor."""
    return np.column_stack([turn(*angles), place])


@st.composite
def mounts(draw: st.DrawFn) -> NDArray[np.float64]:
    """Draw level and tilted mounts on all sides of a car."""
    place = draw(st.tuples(st.floats(-2.5, 2.5), st.floats(-1.0, 1.0), st.floats(0.1, 1.6)))
    yaw = draw(st.sampled_from([0.0, RIGHT, math.pi]) | st.floats(-math.pi, math.pi))
    # In uncompiled kernels, NumPy warns of overflow at angles like 1e-308.
    tilted = st.tuples(st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))
    tilts = draw(st.just((0.0, 0.0)) | tilted.map(lambda tilt: tuple(round(a, 9) for a in tilt)))
    return mount(place, (yaw, *tilts))


@st.composite
def wall_sets(draw: st.DrawFn) -> NDArray[np.void]:
    """Draw up to six walls; some are low, and some cross the vehicle."""
    ends = st.tuples(*(coordinates(40.0) for _ in range(4)))
    height = st.sampled_from([0.5, 3.0, 20.0])
    found = draw(st.lists(st.tuples(ends, height, st.integers(0, 2)), max_size=6))
    rows = [(*corners, tall, number) for corners, tall, number in found
            if math.dist(corners[:2], corners[2:]) > 0.1]  # fmt: skip
    return np.array(rows, WALL)


def one_cell(num: int) -> Grid:
    """Return a spatial index whose only cell has all bodies."""
    index = make_grid((0.0, 0.0, 1.0, 1.0), 1.0, 0)
    index.start[:] = 0, num
    index.largest[0] = 1e3
    return index


def backdrop(
    walls: NDArray[np.void] = NO_WALLS, strips: NDArray[np.float64] | None = None
) -> Backdrop:
    """Return a map with these walls and lanes; type 0 is a car, type 1 a pedestrian."""
    if strips is None:
        strips = np.zeros((0, 4, 2))
    return Backdrop(
        np.array([CAR, PEDESTRIAN], np.uint8),
        strips,
        np.ones(len(strips)),
        one_cell(len(strips)),
        walls,
        one_cell(len(walls)),
        np.zeros((0, 4, 2)),
        np.zeros(0),
        one_cell(0),
    )


def look_around(
    rows: NDArray[np.void], row: int = 0, scenery: Backdrop | None = None, reach_m: float = 100.0
) -> tuple[Panorama, Counts]:
    """Return the scene around a vehicle as a sensor sees it, and its counts."""
    scenery = scenery or backdrop()
    grid = make_grid((-40.0, -40.0, 40.0, 40.0), 10.0, len(rows))
    fill_grid(rows, len(rows), grid)
    panorama = make_panorama(scenery, len(rows))
    return panorama, Counts(*gather(rows, row, grid, scenery, reach_m, True, panorama))
