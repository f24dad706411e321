"""Lines of sight are blocked by walls: a search in cells equals a test of every wall."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl.core.math.walls import is_cut, make_walls
from tests.naive.v2x import crosses

whole = st.integers(-8, 8)


def test_random_lines_are_cut_exactly_if_they_cross_a_wall() -> None:
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
def test_lines_along_borders_of_cells_are_cut_exactly_if_they_cross_a_wall(
    walls: list[tuple[int, int, int, int]], line: tuple[int, int, int, int]
) -> None:
    # Coordinates are whole metres and cells are 2 m wide, so many lines run along borders of cells.
    segments = np.array(walls, dtype=np.float64)
    ends = [float(number) for number in line]
    expected = any(crosses(wall, *ends) for wall in segments.tolist())
    assert is_cut(make_walls(segments, 2.0), *ends) == expected


def test_no_line_is_cut_on_a_map_without_walls() -> None:
    assert not is_cut(make_walls(np.zeros((0, 4))), 0.0, 0.0, 5.0, 5.0)
