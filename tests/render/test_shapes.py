from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.render.overlay import clock_text, scale_bar_m
from cavmarl.render.shapes import convex_hull, offset_polyline, road_shapes
from cavmarl.render.viewport import Viewport
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.mirrored import mirror_net
from tests.support.netgenerate import netgenerate

coordinates = st.tuples(st.integers(-20, 20), st.integers(-20, 20))


@given(st.lists(coordinates, min_size=3, max_size=30))
def test_the_convex_hull_contains_all_points(points: list[tuple[int, int]]) -> None:
    hull = convex_hull(np.array(points, dtype=float))
    assert {tuple(corner) for corner in hull.tolist()} <= {(float(x), float(y)) for x, y in points}
    if len(hull) < 3:
        return
    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        side = (b[0] - a[0]) * (np.array(points)[:, 1] - a[1]) - (b[1] - a[1]) * (
            np.array(points)[:, 0] - a[0]
        )
        assert (side >= 0.0).all()


def test_an_offset_line_keeps_its_distance_at_a_corner() -> None:
    corner = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    assert offset_polyline(corner, 1.0) == pytest.approx(
        np.array([[0.0, 1.0], [9.0, 1.0], [9.0, 10.0]])
    )


def test_stop_lines_divide_the_width_of_a_lane_among_its_links(grid: RoadNetwork) -> None:
    lines = road_shapes(grid).stop_lines
    for lane in np.flatnonzero(grid.lanes["num_links"] > 1)[:20]:
        row = grid.lanes[lane]
        links = np.arange(row["first_link"], row["first_link"] + row["num_links"])
        end = grid.points[row["first_point"] + row["num_points"] - 1]
        left = np.array([-end["sin"], end["cos"]])
        aside = (lines[links].mean(axis=1) - [end["x"], end["y"]]) @ left
        ranks = ["tlLsRr".index(chr(code)) for code in grid.links["direction"][links]]
        assert (np.argsort(-aside) == np.argsort(ranks, kind="stable")).all()
        width = np.hypot(*(lines[links, 0] - lines[links, 1]).T).sum()
        assert width == pytest.approx(row["width_m"] - 0.2)


def test_dashes_between_lanes_are_3_m_long(grid: RoadNetwork) -> None:
    dashes = road_shapes(grid).dashes
    assert len(dashes)
    assert np.linalg.norm(dashes[:, 1] - dashes[:, 0], axis=1) == pytest.approx(3.0)


def test_the_arrow_of_a_lane_has_the_directions_of_its_links(grid: RoadNetwork) -> None:
    lane = int(np.flatnonzero(grid.lanes["num_links"] == 2)[0])  # straight on and one turn
    row = grid.lanes[lane]
    end = grid.points[row["first_point"] + row["num_points"] - 1]
    ahead, left = np.array([[end["cos"], end["sin"]], [-end["sin"], end["cos"]]])
    corners = (road_shapes(grid).arrows[..., :2] - [end["x"], end["y"]]).reshape(-1, 2)
    s, d = corners @ ahead, corners @ left
    on_lane = (np.abs(d) < row["width_m"] / 2.0) & (s < 0.0) & (s > -20.0)
    assert s[on_lane].min() == pytest.approx(-12.0)
    links = grid.links["direction"][row["first_link"] :][:2]
    side = {"l": 1.0, "r": -1.0}[(set(map(chr, links)) - {"s"}).pop()]
    assert (side * d[on_lane]).max() > 2.0 * (-side * d[on_lane]).max()


def test_the_camera_shows_all_of_its_bounds_with_one_scale() -> None:
    camera = Viewport.fit((-100.0, 0.0, 300.0, 50.0), (800, 600), margin_px=40.0)
    corners = camera.to_pixels(np.array([[-100.0, 0.0], [300.0, 50.0]]))
    assert corners[0] == pytest.approx([40.0, 345.0])
    assert corners[1] == pytest.approx([760.0, 255.0])


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0, "0:00.0"), (83.25, "1:23.2"), (59.98, "1:00.0")]
)
def test_the_clock_has_minutes_seconds_and_tenths(seconds: float, text: str) -> None:
    assert clock_text(seconds) == text


@pytest.mark.parametrize(
    ("scale", "length_m"), [(0.4, 200.0), (1.4, 100.0), (5.0, 20.0), (40.0, 2.0)]
)
def test_the_length_of_the_scale_bar_is_a_round_number(scale: float, length_m: float) -> None:
    assert scale_bar_m(scale) == length_m


def test_the_markings_of_left_hand_traffic_are_mirrored(tmp_path: Path) -> None:
    options = ["--grid", "--grid.number", "3", "--grid.length", "120", "-L", "2"]
    plain = netgenerate(tmp_path / "right.net.xml", *options)
    mirror = read_network(mirror_net(plain, tmp_path / "left.net.xml"))
    right, left = road_shapes(read_network(plain)), road_shapes(mirror)
    assert (mirror.links["direction"] == ord("t")).any()
    for name in ("starts", "ends", "dashes", "centre_lines", "stop_lines"):
        shown, other = getattr(right, name), getattr(left, name).copy()
        other[..., 1] *= -1.0
        assert shown.size
        places = (shape.mean(axis=1) if shape.ndim == 3 else shape for shape in (shown, other))
        here, there = (np.round(place[..., :2], 6) + 0.0 for place in places)
        np.testing.assert_allclose(np.unique(here, axis=0), np.unique(there, axis=0), err_msg=name)
