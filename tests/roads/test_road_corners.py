"""Sharp corners within roads become curves that cars can follow; other shapes do not change."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.registry import load_config
from cavmarl.engine.world_setup import load_roads
from cavmarl.evaluate import evaluate
from cavmarl.maps.check import check_map
from cavmarl.maps.defects import find_defects
from cavmarl.roads.polylines import Shape
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.roads.sumo_net.road_corners import find_corners, round_corners
from tests.support.bent_roads import bent_street


def line(*points: tuple[float, ...]) -> Shape:
    return np.array([(*point, 0.0)[:3] for point in points])


def radii(shape: Shape) -> NDArray[np.float64]:
    """Return the radius of the circle through each point and its neighbours."""
    a, b, c = shape[:-2, :2], shape[1:-1, :2], shape[2:, :2]
    one, two, three = (np.hypot(*(p - q).T) for p, q in ((b, a), (c, b), (c, a)))
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2.0
    return one * two * three / np.maximum(4.0 * area, 1e-9)


@pytest.mark.parametrize("turn_deg", [40.0, 90.0, -90.0, 135.0, 160.0])
def test_a_corner_becomes_a_curve_of_the_required_radius(
    turn_deg: float,
) -> None:
    turn = np.radians(turn_deg)
    drawn = line((0, 0), (200, 0), (200 + 200 * np.cos(turn), 200 * np.sin(turn)))
    shapes = [drawn]
    assert round_corners(shapes, [3.2], [range(1)]) == [0]
    (shape,) = shapes
    assert shape[0].tolist() == drawn[0].tolist()
    assert shape[-1].tolist() == drawn[-1].tolist()
    assert np.abs(shape[1, 1]) < 1e-9  # the curve begins on the first segment
    inner = radii(shape)[1:-1]
    assert inner.min() > 0.9 * 12.5 / 1.2
    assert inner.max() < 1.15 * 12.5 / 1.2
    assert find_corners(shape) == []


def test_rounding_keeps_the_distance_between_lanes() -> None:
    shapes = [
        line((0, -3.2 * k), (100 + 3.2 * k, -3.2 * k), (100 + 3.2 * k, 100)) for k in range(3)
    ]
    shapes.append(line((96.8, 100), (96.8, 3.2), (0, 3.2)))  # a lane of the other direction
    assert round_corners(shapes, [3.2] * 4, [range(3), range(3, 4)]) == [0, 1, 2, 3]
    for one, other in ((0, 1), (1, 2), (3, 0)):
        own, far = (
            np.concatenate([np.linspace(*pair, 20) for pair in pairwise(shapes[lane])])
            for lane in (one, other)
        )
        apart = np.hypot(*(own[:, None, :2] - far[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
        assert apart.min() > 3.15


@pytest.mark.parametrize(
    "shape",
    [
        line((0, 0), (100, 0), (180, 50)),  # a turn of 32 degrees
        line(*[(7 * np.sin(t), 7 * np.cos(t)) for t in np.linspace(0, 5, 80)]),
    ],
)
def test_gentle_bends_are_unchanged(shape: Shape) -> None:
    shapes = [shape]
    assert round_corners(shapes, [3.2], [range(1)]) == []
    assert shapes[0] is shape


def test_a_corner_of_several_points_is_rounded_once() -> None:
    shape = line((0, 0), (100, 0), (102, 2), (102, 100))
    (corner,) = find_corners(shape)
    assert (corner.first, corner.last) == (1, 2)
    shapes = [shape]
    assert round_corners(shapes, [3.2], [range(1)]) == [0]
    assert radii(shapes[0])[1:-1].min() > 10.0


def test_curves_of_two_near_corners_divide_the_segment_between_them() -> None:
    shapes = [line((0, 0), (100, 0), (100, 12), (200, 12))]
    assert round_corners(shapes, [3.2], [range(1)]) == [0]
    assert radii(shapes[0])[1:-1].min() == pytest.approx(6.0, rel=0.05)
    shapes = [line((0, 0), (100, 0), (100, 12, 3.0), (200, 12, 3.0))]
    round_corners(shapes, [3.2], [range(1)])
    assert (np.diff(shapes[0][:, 2]) >= 0.0).all()


@pytest.mark.parametrize("lanes", [1, 2])
@pytest.mark.parametrize("turn_deg", [60.0, 90.0, 110.0, 135.0])
def test_cars_drive_around_a_corner_without_a_collision(
    tmp_path: Path, turn_deg: float, lanes: int
) -> None:
    path = bent_street(tmp_path, [turn_deg], lanes=lanes)
    found = evaluate(path, "idm", episodes=8, agents=6, background=0)["idm"]
    assert found.trips >= 48
    assert found["success"].mean == 1.0


def test_rounded_lanes_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = bent_street(tmp_path, [90.0])
    (note,) = read_network(path).notes
    assert note.startswith("rounded the corners of 2 lanes")
    assert note.endswith(": ab_0, ba_0")
    assert check_map(path).notes[0] == note
    load_roads(*load_config(path))
    assert note in caplog.text


def test_a_corner_that_is_too_tight_for_a_car_is_a_defect(tmp_path: Path) -> None:
    path = bent_street(tmp_path, [90.0, 90.0], [300.0, 9.0, 300.0])
    network = read_network(path)
    found = [one for one in find_defects(network, path) if one.kind == "corner too tight for a car"]
    assert [one.name for one in found] == ["ba_0"]
