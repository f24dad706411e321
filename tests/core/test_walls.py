"""A line of sight is blocked if and only if a test of every wall finds a wall on it."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl.core.math.walls import is_cut, make_walls
from tests.naive.v2x import crosses

whole = st.integers(-8, 8)


def test_random_lines_and_walls() -> None:
    random = np.random.default_rng(0)
    starts = random.uniform(-300.0, 300.0, (150, 2))
    walls = np.concatenate([starts, starts + random.normal(0.0, 30.0, (150, 2))], axis=1)
    built = make_walls(walls)
    cut = 0
    for line in random.uniform(-350.0, 350.0, (400, 4)):
        expected = any(crosses(wall, *line) for wall in walls)
        assert is_cut(built, *line) == expected
        cut += expected
    assert 50 < cut < 395


@settings(deadline=None, max_examples=200)
@given(st.lists(st.tuples(whole, whole, whole, whole), min_size=1, max_size=6),
       st.tuples(whole, whole, whole, whole))  # fmt: skip
def test_ends_and_corners_of_cells(
    walls: list[tuple[int, int, int, int]], line: tuple[int, int, int, int]
) -> None:
    # Whole metres in cells of 2 m: many lines run along their borders and through their corners.
    segments = np.array(walls, dtype=np.float64)
    ends = [float(number) for number in line]
    expected = any(crosses(wall, *ends) for wall in segments.tolist())
    assert is_cut(make_walls(segments, 2.0), *ends) == expected


def test_without_walls_no_line_is_cut() -> None:
    assert not is_cut(make_walls(np.zeros((0, 4))), 0.0, 0.0, 5.0, 5.0)
