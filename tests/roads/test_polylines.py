"""Shapes of lanes beside longer or shorter lanes."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.roads.polylines import Shape, split_beside_ends


def straight(first_m: float, last_m: float, y: float) -> Shape:
    return np.array([[first_m, y, 0.0], [last_m, y, 2.0]])


@pytest.mark.parametrize("long_first", [True, False])
def test_a_lane_gets_a_point_where_its_neighbour_ends(long_first: bool) -> None:
    shapes = [straight(0.0, 20.0, 0.0), straight(0.0, 12.0, 3.5)]
    if not long_first:
        shapes.reverse()
    split_beside_ends(shapes, [0])
    long, short = shapes if long_first else shapes[::-1]
    np.testing.assert_allclose(long, [[0.0, 0.0, 0.0], [12.0, 0.0, 1.2], [20.0, 0.0, 2.0]])
    assert len(short) == 2


def test_ends_that_lie_nearly_side_by_side_add_no_points() -> None:
    shapes = [straight(0.0, 20.0, 0.0), straight(2.0, 18.0, 3.5)]
    split_beside_ends(shapes, [0])
    assert [len(shape) for shape in shapes] == [2, 2]
