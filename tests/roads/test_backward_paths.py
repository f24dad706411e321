"""Paths over junctions that run backwards are replaced, and other paths do not change."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.polylines import Shape
from cavmarl.roads.sumo_net.backward_paths import Way, mend_backward_paths
from tests.support.kept_maps import network_of

sumo = pytest.importorskip("sumo", reason="needs the extra: sumo")

MOST_CORNER_RAD = np.radians(100.0)
U_TURN_RAD = np.radians(150.0)  # between roads that turn by more, paths may have sharp corners


def _line(*points: tuple[float, float]) -> Shape:
    return np.array([(x, y, 0.0) for x, y in points])


def _length(shape: Shape) -> float:
    return float(np.hypot(*np.diff(shape[:, :2], axis=0).T).sum())


def _corners(*parts: Shape) -> NDArray[np.float64]:
    """Return the unsigned angles between consecutive segments of polylines, in rad."""
    steps = np.concatenate([np.diff(part[:, :2], axis=0) for part in parts])
    steps /= np.hypot(*steps.T)[:, None]
    cosines: NDArray[np.float64] = (steps[1:] * steps[:-1]).sum(axis=1)
    return np.arccos(np.clip(cosines, -1.0, 1.0))


def _joined(shapes: list[Shape], way: Way) -> Shape:
    return np.concatenate([shapes[way.before], *(shapes[k] for k in way.inside), shapes[way.after]])


def test_roads_that_overlap_are_cut_back_and_joined_by_a_forward_path() -> None:
    shapes = [
        _line((0.0, 0.0), (50.0, 0.0)),
        _line((49.0, 0.1), (100.0, 0.1)),
        _line((50.0, 0.0), (49.0, 0.1)),
    ]
    mend_backward_paths(shapes, [Way(0, (2,), 1)])
    whole = _joined(shapes, Way(0, (2,), 1))
    assert (np.diff(whole[:, 0]) >= 0.0).all()
    assert shapes[2][0].tolist() == shapes[0][-1].tolist()
    assert shapes[2][-1].tolist() == shapes[1][0].tolist()
    assert _length(shapes[2]) > 0.5


def test_other_paths_from_the_same_lane_keep_their_course() -> None:
    shapes = [
        _line((0.0, 0.0), (50.0, 0.0)),
        _line((49.0, 0.1), (100.0, 0.1)),
        _line((60.0, 10.0), (60.0, 50.0)),
        _line((50.0, 0.0), (49.0, 0.1)),
        _line((50.0, 0.0), (57.0, 3.0), (60.0, 10.0)),
    ]
    turn = Way(0, (4,), 2)
    before = _length(_joined(shapes, turn))
    mend_backward_paths(shapes, [Way(0, (3,), 1), turn])
    assert _length(shapes[0]) < 50.0
    assert _length(_joined(shapes, turn)) == pytest.approx(before, abs=1e-9)
    assert shapes[4][-3:].tolist() == _line((50.0, 0.0), (57.0, 3.0), (60.0, 10.0)).tolist()


def test_a_path_of_several_lanes_is_replaced_by_the_same_number_of_lanes() -> None:
    shapes = [
        _line((0.0, 0.0), (50.0, 0.0)),
        _line((48.0, 2.0), (48.0, 60.0)),
        _line((50.0, 0.0), (49.5, 0.5)),
        _line((49.5, 0.5), (48.0, 2.0)),
    ]
    way = Way(0, (2, 3), 1)
    mend_backward_paths(shapes, [way])
    assert shapes[2][-1].tolist() == shapes[3][0].tolist()
    assert _corners(*(shapes[k] for k in (0, 2, 3, 1))).max() < np.radians(60.0)


def test_paths_that_a_car_can_follow_are_unchanged() -> None:
    shapes = [
        _line((0.0, 0.0), (50.0, 0.0)),
        _line((50.0, 3.2), (0.0, 3.2)),
        _line((50.0, 0.0), (53.0, 0.0), (53.0, 3.2), (50.0, 3.2)),
    ]
    drawn = [shape.tolist() for shape in shapes]
    mend_backward_paths(shapes, [Way(0, (2,), 1)])
    assert [shape.tolist() for shape in shapes] == drawn


def test_a_lane_keeps_its_end_if_one_of_its_movements_has_no_path() -> None:
    shapes = [
        _line((0.0, 0.0), (50.0, 0.0)),
        _line((49.0, 0.1), (100.0, 0.1)),
        _line((50.0, 0.0), (49.0, 0.1)),
        _line((50.0, 0.0), (60.0, 50.0)),
    ]
    mend_backward_paths(shapes, [Way(0, (2,), 1), Way(0, (), 3)])
    assert shapes[0].tolist() == _line((0.0, 0.0), (50.0, 0.0)).tolist()
    assert shapes[2][-1].tolist() == shapes[1][0].tolist()


def _check_forward(network: RoadNetwork) -> None:
    """Check that no path over a junction runs backwards, except paths of U-turns."""
    for link in network.links[network.links["first_internal"] >= 0]:
        lanes = [int(link["from_lane"]), int(link["first_internal"])]
        while network.lanes["internal"][lanes[-1]]:
            lanes.append(int(network.lanes["successor"][lanes[-1]]))
        parts = [network.lane_polyline(lane) for lane in lanes]
        corners = _corners(parts[0][-2:], *parts[1:-1], parts[-1][:2])
        between = _corners(parts[0][-2:], parts[-1][:2])[0]
        name = network.lane_ids[lanes[1]]
        if between < U_TURN_RAD:
            assert corners.max() < MOST_CORNER_RAD, (name, np.degrees(corners.max()))


@pytest.mark.parametrize(
    "name", ["DRT/osm", "A10KW/osm", "bs3d/bs", "highway/highway", "corridor/corridor"]
)
def test_no_path_of_a_map_of_sumo_runs_backwards(name: str) -> None:
    _check_forward(network_of(Path(sumo.SUMO_HOME) / f"tools/game/{name}.net.xml"))


@pytest.mark.parametrize(
    "name", ["osm/monaco.osm.gz", "xodr/Town01.xodr", "xodr/Town04.xodr", "xodr/newmarket.xodr"]
)
def test_no_path_of_a_real_map_runs_backwards(built_map: Callable[[str], Path], name: str) -> None:
    _check_forward(network_of(built_map(name)))


@pytest.mark.parametrize("name", ["bologna_acosta/acosta_buslanes", "mcity/mcity", "Town10HD"])
def test_no_path_of_a_city_runs_backwards(shared_maps: Path, name: str) -> None:
    _check_forward(network_of(shared_maps / "net" / f"{name}.net.xml"))


def test_a_replaced_path_has_a_constant_grade() -> None:
    shapes = [
        _line((0.0, 0.0), (50.0, 0.0)),
        _line((49.0, 0.1), (50.0, 40.0)),
        _line((50.0, 0.0), (49.0, 0.1)),
    ]
    shapes[1][:, 2] = 0.5
    shapes[2][-1, 2] = 0.5
    mend_backward_paths(shapes, [Way(0, (2,), 1)])
    step = np.diff(shapes[2], axis=0)
    grade = step[:, 2] / np.hypot(step[:, 0], step[:, 1])
    assert grade == pytest.approx(np.full(len(grade), grade[0]), rel=1e-6)
    assert shapes[2][[0, -1], 2].tolist() == [0.0, 0.5]
