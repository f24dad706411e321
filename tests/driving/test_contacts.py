from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import make_grid
from cavmarl.driving.kernels.motion.contacts import find_contacts
from tests.naive import contacts as naive
from tests.support.builders import crowds, vehicles


def contacts(rows: NDArray[np.void], cell_m: float = 10.0) -> list[int]:
    grid = make_grid((-20.0, -15.0, 25.0, 20.0), cell_m, len(rows))
    hit = np.full(len(rows), 99, np.int64)
    find_contacts(rows, len(rows), grid, hit)
    return hit.tolist()


@given(crowds(), st.sampled_from([4.0, 25.0]))
def test_contacts_equal_twin(rows: NDArray[np.void], cell_m: float) -> None:
    hits = contacts(rows, cell_m)
    # If two boxes only touch at their edges, rounding decides, so skip such cases.
    if naive.find_contacts(rows, 1e-6) == naive.find_contacts(rows, -1e-6):
        assert hits == naive.find_contacts(rows)


@given(crowds(), st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(rows: NDArray[np.void], random: object) -> None:
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    hits = contacts(rows)
    assert contacts(rows[order]) == [hits[row] for row in order]


@pytest.mark.parametrize(
    ("heading", "reach_m"), [(0.0, 2.0), (0.3, 2.69), (-0.3, 2.69), (7.0, 3.396)]
)
def test_widths_and_angle_decide_whether_adjacent_vehicles_touch(
    heading: float, reach_m: float
) -> None:
    for apart_m, touch in ((reach_m - 0.02, [1, 0]), (reach_m + 0.02, [-1, -1])):
        for sign in (1.0, -1.0):
            rows = vehicles([(0.0, 0.0, 0.0), (0.0, sign * apart_m, heading)])
            rows["length"], rows["width"] = 5.0, 2.0
            assert contacts(rows) == touch


def test_vehicles_on_and_under_a_bridge_do_not_touch() -> None:
    places = [(0.0, 0.0, 0.0), (1.0, 0.0, math.pi / 2)]
    assert contacts(vehicles(places, z=[0.0, 5.0])) == [-1, -1]
    assert contacts(vehicles(places, z=[0.0, 1.5])) == [-1, -1]
    assert contacts(vehicles(places, z=[0.0, 1.4])) == [1, 0]


def test_a_vehicle_with_several_contacts_records_the_smallest_id() -> None:
    rows = vehicles([(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (-4.0, 0.0, 0.0)], id=[5, 3, 8])
    assert contacts(rows) == [3, 5, 5]


def test_contacts_of_trucks_longer_than_a_cell_are_found() -> None:
    rows = vehicles([(-9.0, 0.0, 0.0), (8.9, 0.0, 0.0)], length=18.0)
    assert contacts(rows, 2.0) == [1, 0]
    rows["x"][1] = 9.0
    assert contacts(rows, 2.0) == [-1, -1]


def test_a_car_finds_a_truck_that_it_touches_far_from_the_trucks_centre() -> None:
    rows = vehicles([(-9.0, 0.0, 0.0), (2.4, 0.0, 0.0)], length=[18.0, 5.0])
    assert contacts(rows, 2.0) == [1, 0]
