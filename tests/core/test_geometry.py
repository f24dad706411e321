from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.math import geometry
from tests.naive import geometry as naive
from tests.support.builders import angles, coordinates, points_of, polylines

BOX = st.tuples(
    coordinates(12.0), coordinates(12.0), angles(), st.floats(0.1, 9.0), st.floats(0.1, 3.0)
)
U_TURN = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [100.0, 10.0, 0.0], [0.0, 10.0, 0.0]])


@given(st.floats(-1e4, 1e4) | st.integers(-8, 8).map(lambda n: n * math.pi))
def test_wrap_angle_equals_twin(angle: float) -> None:
    wrapped = geometry.wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert abs(naive.wrap_angle(wrapped - naive.wrap_angle(angle))) < 1e-12


def test_wrap_angle_returns_pi_for_minus_pi() -> None:
    assert geometry.wrap_angle(-math.pi) == math.pi
    assert geometry.wrap_angle(math.pi) == math.pi
    assert geometry.wrap_angle(math.nextafter(math.pi, 4.0)) == pytest.approx(-math.pi)


@given(polylines(), st.floats(-0.5, 1.5))
def test_lane_pose_equals_twin(corners: NDArray[np.float64], share: float) -> None:
    points = points_of(corners)
    s = share * float(points["s"][-1])
    # At a corner, rounding decides which of the two segments is found.
    assume(np.min(np.abs(points["s"][1:-1] - s), initial=np.inf) > 1e-9)
    pose = geometry.lane_pose(points, 0, len(points), s)
    assert pose == pytest.approx(naive.lane_pose(corners, s), abs=1e-9)


def test_at_a_corner_the_next_segment_is_found() -> None:
    points = points_of(U_TURN)
    found = [geometry.segment_at(points, 0, 4, s) for s in (-1.0, 0.0, 99.0, 100.0, 110.0, 300.0)]
    assert found == [0, 0, 0, 1, 2, 2]
    assert geometry.lane_pose(points, 0, 4, 100.0) == (100.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def test_lane_pose_uses_only_its_polyline() -> None:
    points = np.concatenate([points_of(U_TURN), points_of(U_TURN + np.array([0.0, 50.0, 3.0]))])
    assert geometry.lane_pose(points, 4, 4, 30.0) == (30.0, 50.0, 3.0, 1.0, 0.0, 0.0)
    assert geometry.lane_pose(points, 0, 4, 215.0)[:2] == (-5.0, 10.0)


@given(polylines(), coordinates(80.0), coordinates(80.0))
def test_project_equals_twin(corners: NDArray[np.float64], x: float, y: float) -> None:
    points = points_of(corners)
    length = float(points["s"][-1])
    s, d, cos, sin = geometry.project(points, 0, len(points), x, y)
    distance, nearest_s = naive.nearest_on_polyline(corners[:, :2], x, y)
    clamped = min(max(s, 0.0), length)
    foot = naive.lane_pose(corners, clamped)
    assert math.hypot(x - foot[0], y - foot[1]) == pytest.approx(distance, abs=1e-9)
    # If two places are equally near, rounding decides which `s` is found.
    assert clamped == pytest.approx(nearest_s, abs=1e-6) or clamped > nearest_s
    if 0.0 <= s <= length:
        assert abs(d) == pytest.approx(distance, abs=1e-9)
    else:
        foot = naive.lane_pose(corners, s)
        assert (foot[0] - d * sin, foot[1] + d * cos) == pytest.approx((x, y), abs=1e-9)


@given(polylines(), coordinates(80.0), coordinates(80.0))
def test_project_near_equals_project_if_the_nearest_place_is_in_the_window(
    corners: NDArray[np.float64], x: float, y: float
) -> None:
    points = points_of(corners)
    num, length = len(points), float(points["s"][-1])
    whole = geometry.project(points, 0, num, x, y)
    assert geometry.project_near(points, 0, num, x, y, 0.5 * length, length) == whole
    assert geometry.project_near(points, 0, num, x, y, whole[0], 5.0) == whole


def test_project_returns_the_smaller_s_of_two_equally_near_places() -> None:
    points = points_of(U_TURN)
    assert geometry.project(points, 0, 4, 40.0, 5.0) == (40.0, 5.0, 1.0, 0.0)


def test_project_near_finds_only_the_part_of_a_u_turn_near_the_given_s() -> None:
    points = points_of(U_TURN)
    s, d, cos, _ = geometry.project_near(points, 0, 4, 40.0, 4.0, 160.0, 20.0)
    assert (s, d, cos) == (170.0, 6.0, -1.0)


@pytest.mark.parametrize("turn", [1.0, -1.0])
@pytest.mark.parametrize("y", [1.5, -1.5])
def test_project_of_a_point_beyond_a_hairpin_has_d_on_the_outer_side(turn: float, y: float) -> None:
    # The line goes east and returns, with its end 1 m to the left (turn 1) or right of its start.
    points = points_of(np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, turn, 0.0]]))
    s, d, _, _ = geometry.project(points, 0, 3, 52.0, y)
    assert (s, d) == (50.0, -turn * 2.5)


def test_project_near_after_a_hairpin_has_d_on_the_outer_side() -> None:
    points = points_of(np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    s, d, _, _ = geometry.project_near(points, 0, 3, 52.0, -1.5, 60.0, 1.0)
    assert (s, d) == pytest.approx((50.0, -2.5))


@given(BOX, BOX)
def test_boxes_overlap_equals_twin(one: tuple[float, ...], other: tuple[float, ...]) -> None:
    def grown(box: tuple[float, ...], margin: float) -> list[naive.Point]:
        x, y, heading, half_length, half_width = box
        return naive.box_corners(x, y, heading, half_length + margin, half_width + margin)

    def split(box: tuple[float, ...]) -> tuple[float, ...]:
        return (box[0], box[1], math.cos(box[2]), math.sin(box[2]), box[3], box[4])

    overlap = geometry.boxes_overlap(*split(one), *split(other))
    assert overlap == geometry.boxes_overlap(*split(other), *split(one))
    if naive.common_area(grown(one, -1e-6), grown(other, -1e-6)) > 1e-12:
        assert overlap
    if naive.common_area(grown(one, 1e-6), grown(other, 1e-6)) <= 0.0:
        assert not overlap


def test_boxes_that_touch_do_not_overlap() -> None:
    assert not geometry.boxes_overlap(0.0, 0.0, 1.0, 0.0, 2.5, 1.0, 5.0, 0.0, 1.0, 0.0, 2.5, 1.0)
    assert not geometry.boxes_overlap(0.0, 0.0, 1.0, 0.0, 2.5, 1.0, 3.5, 0.0, 0.0, 1.0, 2.5, 1.0)
    assert geometry.boxes_overlap(0.0, 0.0, 1.0, 0.0, 2.5, 1.0, 3.499, 0.0, 0.0, 1.0, 2.5, 1.0)
