from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import BODY, Grid, fill_grid, make_grid, nearest_bodies
from tests.naive import neighbors as naive
from tests.support.builders import crowds, vehicles


def grid_of(rows: NDArray[np.void], cell_m: float = 10.0) -> Grid:
    # Vehicles are drawn in a larger area than the grid, so some of them lie outside.
    grid = make_grid((-20.0, -15.0, 25.0, 20.0), cell_m, len(rows))
    fill_grid(rows, len(rows), grid)
    return grid


def nearest(
    rows: NDArray[np.void], row: int, radius_m: float, k: int, cell_m: float = 10.0
) -> list[tuple[float, int]]:
    """Return (squared distance, row) of the vehicles found."""
    out_body, out_squared = np.full(k, -7, np.int32), np.full(k, -7.0)
    me, grid = rows[row], grid_of(rows, cell_m)
    place = (me["x"], me["y"], me["z"])
    found = nearest_bodies(grid, row, *place, radius_m, k, out_body, out_squared)
    assert np.all(out_body[found:] == -7)
    found_rows = grid.bodies[out_body[:found]]["row"]
    return list(zip(out_squared[:found].tolist(), found_rows.tolist(), strict=True))


@given(crowds(), st.sampled_from([3.0, 10.0, 100.0]))
def test_each_row_has_one_body_in_its_cell(rows: NDArray[np.void], cell_m: float) -> None:
    grid = grid_of(rows, cell_m)
    bodies = grid.bodies[: len(rows)]
    assert sorted(bodies["row"].tolist()) == list(range(len(rows)))
    assert grid.start[0] == 0
    assert grid.start[-1] == len(rows)
    for cell in range(grid.num_x * grid.num_y):
        for body in bodies[grid.start[cell] : grid.start[cell + 1]]:
            row = rows[body["row"]]
            column = min(max(int((row["x"] + 20.0) // cell_m), 0), grid.num_x - 1)
            line = min(max(int((row["y"] + 15.0) // cell_m), 0), grid.num_y - 1)
            assert cell == line * grid.num_x + column
            assert (body["id"], body["x"], body["y"]) == (row["id"], row["x"], row["y"])
            assert (body["cos"], body["sin"]) == pytest.approx(
                (np.cos(row["heading"]), np.sin(row["heading"]))
            )
    assert grid.largest[0] == np.hypot(0.5 * rows["length"], 0.5 * rows["width"]).max()


@given(
    crowds(), st.integers(0, 11), st.sampled_from([1.0, 10.0, 25.0, 200.0]), st.integers(1, 6),
    st.sampled_from([4.0, 10.0, 100.0]),
)  # fmt: skip
def test_nearest_bodies_equals_twin(
    rows: NDArray[np.void], row: int, radius_m: float, k: int, cell_m: float
) -> None:
    row %= len(rows)
    me = rows[row]
    twin = naive.k_nearest(rows, row, me["x"], me["y"], me["z"], radius_m, k)
    assert nearest(rows, row, radius_m, k, cell_m) == twin


@given(crowds(), st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_change_the_neighbours(
    rows: NDArray[np.void], random: object
) -> None:
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    shuffled = rows[order]
    for place, row in enumerate(order):
        ids = [(squared, rows[i]["id"]) for squared, i in nearest(rows, row, 40.0, 4)]
        again = [(squared, shuffled[i]["id"]) for squared, i in nearest(shuffled, place, 40.0, 4)]
        assert ids == again


def test_equal_distances_are_ordered_by_id_and_other_road_levels_are_ignored() -> None:
    rows = vehicles(
        [(0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 9.0, 0.0), (-9.0, 0.0, 0.0), (0.0, 5.0, 0.0)],
        id=[4, 9, 2, 7, 1],
        z=[0.0, 0.0, 4.0, -4.0, 4.1],
    )
    assert nearest(rows, 0, 9.0, 2) == [(81.0, 2), (81.0, 3)]


def test_a_search_works_at_a_place_without_a_vehicle() -> None:
    rows = vehicles([(1.0, 0.0, 0.0)])
    out_body, out_squared = np.zeros(4, np.int32), np.zeros(4)
    assert nearest_bodies(grid_of(rows), -1, 0.0, 0.0, 0.0, 5.0, 4, out_body, out_squared) == 1


def test_the_grid_takes_huge_and_undefined_coordinates() -> None:
    rows = vehicles([(np.nan, 0.0, 0.0), (1e100, -1e100, 0.0), (0.0, np.nan, 0.0), (1.0, 1.0, 0.0)])
    assert nearest(rows, 3, 50.0, 4) == []


def test_a_body_takes_at_most_96_bytes() -> None:
    assert BODY.itemsize <= 96
