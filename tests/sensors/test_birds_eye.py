from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.sensors.kernels.panorama import CAR, GROUND, LANE_LINE, PEDESTRIAN, ROAD
from cavmarl.sensors.kernels.rig_pictures import look_down, make_birds_eye
from tests.naive import imaging as naive
from tests.support.builders import crowds, vehicles
from tests.support.imaging import backdrop, look_around, mount

Floats = NDArray[np.float64]
SIZE = 24
CELL_M = 1.5
HALF_M = 0.5 * SIZE * CELL_M


def seen(
    rows: NDArray[np.void], strips: Floats | None = None, row: int = 0, yaw: float = 0.0
) -> NDArray[np.uint8]:
    panorama, counts = look_around(rows, row, backdrop(strips=strips), 60.0)
    grid = make_birds_eye(mount(angles=(yaw, 0.0, 0.0)), HALF_M, HALF_M, CELL_M)
    out = np.zeros((SIZE, SIZE), np.uint8)
    look_down(grid, panorama, counts, out)
    return out


@given(crowds(most=6), st.sampled_from([0.0, 1.0]))
def test_cells_equal_twin(rows: NDArray[np.void], yaw: float) -> None:
    out = seen(rows, yaw=yaw)
    ego = rows[0]
    angle = ego["heading"] + yaw
    bodies = naive.seen_bodies(rows, 0)
    for j, i in np.ndindex(SIZE, SIZE):
        ahead = HALF_M - (j + 0.5) * CELL_M
        left = HALF_M - (i + 0.5) * CELL_M
        x = ego["x"] + ahead * math.cos(angle) - left * math.sin(angle)
        y = ego["y"] + ahead * math.sin(angle) + left * math.cos(angle)
        surely = any(naive.covers(body, x, y, -1e-6) for body in bodies)
        maybe = any(naive.covers(body, x, y, 1e-6) for body in bodies)
        if surely == maybe:
            assert out[j, i] == (CAR if surely else GROUND)


@given(crowds(), st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(rows: NDArray[np.void], random: object) -> None:
    rows["vtype"][::2] = 1
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    for place, row in enumerate(order):
        assert seen(rows, row=row).tobytes() == seen(rows[order], row=place).tobytes()


def test_the_top_of_the_grid_is_ahead_and_its_left_side_is_left() -> None:
    rows = vehicles([(0.0, 0.0, 0.5), (8 * math.cos(0.5), 8 * math.sin(0.5), 0.5)])
    rows = np.concatenate([rows, vehicles([(-9 * math.sin(0.5), 9 * math.cos(0.5), 0.5)], id=2)])
    rows["vtype"][2] = 1
    out = seen(rows)
    cars, walkers = np.argwhere(out == CAR), np.argwhere(out == PEDESTRIAN)
    assert cars[:, 0].max() < SIZE // 2
    assert cars[:, 1].mean() == pytest.approx(0.5 * SIZE - 0.5, abs=0.6)
    assert walkers[:, 1].max() < SIZE // 2


def test_the_grid_shows_lane_lines_roads_and_bodies_on_top() -> None:
    strip = np.array([[(-20.0, -2.2), (-20.0, 2.2), (20.0, 2.2), (20.0, -2.2)]])
    out = seen(vehicles([(0.0, 0.0, 0.0), (6.0, 2.0, 0.0)]), strip)
    column = int((HALF_M - 2.2) / CELL_M)
    assert out[-1, column] == LANE_LINE
    assert out[-1, SIZE // 2] == ROAD
    assert out[-1, 0] == GROUND
    assert out[int((HALF_M - 6.0) / CELL_M), column] == CAR
