from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.maps.netconvert import map_file
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.zones.partition.zone_layouts import MIN_SIDE_M, cut_map
from cavmarl.zones.partition.zone_statistics import zone_statistics
from cavmarl.zones.partition.zone_survey import junction_boxes, lane_samples, lane_segments

MAPS = [
    "osm/berlin_siegessaeule.osm.gz",
    "xodr/Town04.xodr",
    "net/bologna_acosta/acosta_buslanes.net.xml",
]
LAYOUTS = ["grid", "strips", "bisection"]


@pytest.fixture
def cross(crossing: Callable[..., Path]) -> RoadNetwork:
    """Return a map of 200 m x 200 m with a junction of 10 m in the middle."""
    return read_network(crossing())


@pytest.fixture(scope="session", params=MAPS)
def city(request: pytest.FixtureRequest, shared_maps: Path) -> RoadNetwork:
    return load_network(map_file(shared_maps / request.param))


@pytest.mark.parametrize(
    ("layout", "count", "shape"),
    [
        ("grid", 4, (2, 2)), ("grid", 6, (2, 3)), ("grid", 5, (1, 5)), ("strips", 4, (1, 4)),
    ],
)  # fmt: skip
def test_grids_have_equal_cells(
    cross: RoadNetwork, layout: str, count: int, shape: tuple[int, int]
) -> None:
    zones = cut_map(cross, layout, count)
    assert zones.bounds == (-105.0, -105.0, 105.0, 105.0)
    assert zones.arrays.cells.tolist() == np.arange(count).reshape(shape).tolist()
    sides = zones.rects[:, 2:] - zones.rects[:, :2]
    assert sides == pytest.approx(np.full((count, 2), (210.0 / shape[1], 210.0 / shape[0])))


def test_lanes_are_sampled_from_end_to_end(cross: RoadNetwork) -> None:
    segments, samples = lane_segments(cross), lane_samples(cross)
    assert samples[:, 2].sum() == pytest.approx(5 * 95.0)
    assert np.hypot(*(segments[:, 2:] - segments[:, :2]).T).sum() == pytest.approx(5 * 95.0)
    east = samples[(samples[:, 0] > 5.0)]
    assert np.diff(east[:, 0]) == pytest.approx(95.0 / 48)
    assert not east[:, 1].any()


def test_the_box_of_a_junction_contains_its_internal_lanes(cross: RoadNetwork) -> None:
    half = 0.5 * cross.lanes["width_m"][0]
    assert junction_boxes(cross) == pytest.approx(
        np.array([[-5.0 - half, -5.0 - half, 5.0 + half, 5.0 + half]])
    )


@pytest.mark.parametrize("layout", ["grid", "strips"])
def test_cuts_can_avoid_junctions(cross: RoadNetwork, layout: str) -> None:
    plain = cut_map(cross, layout, 2)
    kept = cut_map(cross, layout, 2, avoid_junctions=True)
    assert zone_statistics(plain, cross).junctions_cut == 1
    assert zone_statistics(kept, cross).junctions_cut == 0


def test_zones_can_have_equal_density_instead_of_lane_length(cross: RoadNetwork) -> None:
    crowd = np.array([[x, 0.0, 1.0] for x in range(40)] + [[-90.0, 0.0, 40.0], [70.0, 0.0, 0.0]])
    zones = cut_map(cross, "bisection", 2, density=crowd)
    assert -90.0 < zones.arrays.cuts_x[0] <= 0.0
    with pytest.raises(ConfigError, match="density: must be rows of finite x, y and weight"):
        cut_map(cross, "bisection", 2, density=crowd[:, :2])
    with pytest.raises(ConfigError, match="density"):
        cut_map(cross, "bisection", 2, density=crowd * np.nan)


def test_an_unknown_weight_is_refused(cross: RoadNetwork) -> None:
    with pytest.raises(ConfigError, match="weight 'speed' does not exist; use lane_length"):
        cut_map(cross, "bisection", 2, weight="speed")


def test_zones_can_have_equal_area(cross: RoadNetwork) -> None:
    rects = cut_map(cross, "bisection", 3, weight="uniform").rects
    assert np.prod(rects[:, 2:] - rects[:, :2], axis=1) == pytest.approx(210.0 * 70.0)


@pytest.mark.parametrize(
    ("layout", "count", "words"),
    [
        ("grid", 0, "0 zones: must be a whole number from 1 to 256"),
        ("grid", 257, "257 zones: must be .* to 256"),
        ("rings", 4, "layout 'rings' does not exist; use grid, strips, bisection"),
        ("strips", 50, r"1 rows and 50 columns of a map of 210 m x 210 m .* 210\.00 m x 4\.20 m"),
        ("grid", 53, r"53 zones: .* at least 5 m, so use fewer"),
        ("bisection", 256, r"no cut divides x .*, y .* into \d+ zones"),
    ],
)
def test_layouts_that_do_not_fit_the_map_are_refused(
    cross: RoadNetwork, layout: str, count: int, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        cut_map(cross, layout, count)


def test_a_straight_road_can_be_cut(crossing: Callable[..., Path]) -> None:
    lane = 'shape="0,-100 0,-5"'
    network = read_network(crossing((lane, 'shape="-60,0 -5,0"')))
    for layout in LAYOUTS:
        zones = cut_map(network, layout, 7)
        assert zones.count == 7
        assert (zones.rects[:, 2:] - zones.rects[:, :2]).min() >= MIN_SIDE_M


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("avoid", [False, True])
def test_real_maps_are_cut(city: RoadNetwork, layout: str, avoid: bool) -> None:
    for count in (1, 2, 3, 4, 9, 16):
        zones = cut_map(city, layout, count, avoid_junctions=avoid)
        again = cut_map(city, layout, count, avoid_junctions=avoid)
        assert zones.count == count
        assert zones.content_hash == again.content_hash
        assert (zones.rects[:, 2:] - zones.rects[:, :2]).min() >= MIN_SIDE_M
        found = zone_statistics(zones, city)
        metres = np.hypot(*(lane_segments(city)[:, 2:] - lane_segments(city)[:, :2]).T).sum()
        assert sum(found.lane_km) == pytest.approx(metres / 1e3)


def test_bisection_divides_lane_length_evenly(city: RoadNetwork) -> None:
    plain = zone_statistics(cut_map(city, "bisection", 4), city)
    kept = zone_statistics(cut_map(city, "bisection", 4, avoid_junctions=True), city)
    assert plain.lane_imbalance < 1.01
    assert kept.lane_imbalance < 1.3
    assert kept.junctions_cut <= plain.junctions_cut


def test_junctions_are_not_cut_if_possible(shared_maps: Path) -> None:
    town = load_network(map_file(shared_maps / "xodr/Town04.xodr"))
    plain, kept = (
        zone_statistics(cut_map(town, "bisection", 4, avoid_junctions=avoid), town)
        for avoid in (False, True)
    )
    assert kept.junctions_cut < plain.junctions_cut
