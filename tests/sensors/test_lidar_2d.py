from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.math import bearings
from cavmarl.core.math.neighbors import fill_grid, make_grid
from cavmarl.sensors.kernels import lidar_2d as sensing
from tests.naive import sensing as naive
from tests.support.builders import crowds, vehicles


def scan(
    rows: NDArray[np.void], row: int, num_rays: int = 16, range_m: float = 60.0
) -> NDArray[np.void]:
    grid = make_grid((-20.0, -15.0, 25.0, 20.0), 10.0, len(rows))
    fill_grid(rows, len(rows), grid)
    out = np.zeros(num_rays, sensing.ECHO)
    sensing.lidar(rows, row, grid, sensing.ray_directions(num_rays), range_m, out)
    return out


@given(
    crowds(most=8), st.integers(0, 7), st.sampled_from([1, 4, 16, 33]),
    st.sampled_from([5.0, 20.0, 60.0]),
)  # fmt: skip
def test_lidar_equals_twin(rows: NDArray[np.void], row: int, num_rays: int, range_m: float) -> None:
    row %= len(rows)
    out = scan(rows, row, num_rays, range_m)
    # Rounding decides whether a ray along a side hits it, so compute with sizes 1 µm larger and
    # smaller.
    nearer = naive.lidar(rows, row, num_rays, range_m, 1e-6)
    further = naive.lidar(rows, row, num_rays, range_m, -1e-6)
    twin = naive.lidar(rows, row, num_rays, range_m)
    for ray in range(num_rays):
        assert nearer[ray][0] - 1e-9 <= out[ray]["distance"] <= further[ray][0] + 1e-9
        if further[ray][0] - nearer[ray][0] < 1e-3:
            assert out[ray]["distance"] == pytest.approx(twin[ray][0], abs=1e-3)
            assert (out[ray]["id"] == -1) == (out[ray]["distance"] == range_m)


@given(crowds(), st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(rows: NDArray[np.void], random: object) -> None:
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    shuffled = rows[order]
    for place, row in enumerate(order):
        assert scan(rows, row).tobytes() == scan(shuffled, place).tobytes()


@given(st.floats(3.0, 50.0), st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi))
def test_no_ray_that_meets_a_body_is_skipped(
    distance: float, direction: float, heading: float
) -> None:
    place = (distance * math.cos(direction), distance * math.sin(direction), heading)
    rows = vehicles([(0.0, 0.0, 0.3), place])
    out = scan(rows, 0, 128)
    twin = naive.lidar(rows, 0, 128, 60.0, -1e-6)
    assert np.all(out["distance"] <= np.array([d for d, _ in twin]) + 1e-9)


def test_rays_beside_a_corner_do_not_hit_the_body() -> None:
    """The 720 rays pass each corner of a rotated body closely on both sides."""
    for k in range(8):
        place = (7.0 * math.cos(0.8 * k), 7.0 * math.sin(0.8 * k), 0.35 * k)
        rows = vehicles([(0.0, 0.0, 0.3), place], length=8.0)
        out = scan(rows, 0, 720)
        nearer, further = (naive.lidar(rows, 0, 720, 60.0, margin) for margin in (1e-6, -1e-6))
        sure = [a[0] - b[0] < 1e-3 for a, b in zip(further, nearer, strict=True)]
        assert sum(sure) > 700
        for ray in np.flatnonzero(sure):
            assert out[ray]["distance"] == pytest.approx(nearer[ray][0], abs=1e-3)


def test_rays_are_listed_counter_clockwise_from_the_ray_ahead() -> None:
    heading = 1.0
    ahead = (20.0 * math.cos(heading), 20.0 * math.sin(heading), heading)
    left = (-10.0 * math.sin(heading), 10.0 * math.cos(heading), heading)
    out = scan(vehicles([(0.0, 0.0, heading), ahead, left]), 0, 4)
    assert out["distance"] == pytest.approx([17.5, 9.0, 60.0, 60.0])
    assert out["id"].tolist() == [1, 2, -1, -1]


def test_the_speed_of_a_body_that_moves_away_is_positive() -> None:
    rows = vehicles(
        [(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (0.0, 10.0, 0.0), (-20.0, 0.0, 0.0)],
        speed=[10.0, 13.0, 10.0, 12.0],
    )
    assert scan(rows, 0, 4)["speed"] == pytest.approx([3.0, 0.0, -2.0, 0.0])


def test_the_distance_inside_a_body_is_zero() -> None:
    out = scan(vehicles([(0.0, 0.0, 0.0), (1.0, 0.5, 0.7)]), 0, 8)
    assert np.all(out["distance"] == 0.0)
    assert np.all(out["id"] == 1)


def test_a_ray_reports_the_smaller_id_of_equally_near_bodies() -> None:
    places = [(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (20.0, 0.0, 0.0)]
    assert scan(vehicles(places, id=[1, 6, 4]), 0, 4)["id"][0] == 4
    assert scan(vehicles(places, id=[1, 4, 6]), 0, 4)["id"][0] == 4


def test_bodies_beyond_the_range_or_on_other_levels_are_not_seen() -> None:
    rows = vehicles([(0.0, 0.0, 0.0), (62.4, 0.0, 0.0), (0.0, 10.0, 0.0)], z=[0.0, 0.0, 4.5])
    assert scan(rows, 0, 4)["distance"] == pytest.approx([59.9, 60.0, 60.0, 60.0])
    rows["x"][1] = 62.6
    assert np.all(scan(rows, 0, 4)["id"] == -1)


def test_the_end_of_a_truck_is_seen_when_its_centre_is_out_of_range() -> None:
    rows = vehicles([(-15.0, 0.0, 0.0), (13.0, 0.0, 0.0)], length=[5.0, 18.0])
    assert scan(rows, 0, 4, range_m=20.0)["distance"] == pytest.approx([19.0, 20.0, 20.0, 20.0])


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_the_approximate_angle_is_within_its_bound(y: float, x: float) -> None:
    if x == 0.0 and y == 0.0:
        return
    error = math.remainder(bearings.rough_atan2(y, x) - math.atan2(y, x), 2.0 * math.pi)
    assert abs(error) < bearings.ANGLE_ERROR_RAD
