"""Heights of networks equal the model and are continuous; x and y do not change."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, MapError
from cavmarl.maps.check import check_map
from cavmarl.maps.heights.draping import CLEARANCE_M, HeightOptions, HeightReport
from cavmarl.maps.heights.height_model import HeightModel
from cavmarl.maps.net_document import NetDocument
from cavmarl.maps.netconvert import BuildResult, build_network
from cavmarl.maps.projection import unproject
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net import reader
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.kept_maps import network_of
from tests.support.terrain import TOWN, plane, write_geotiff, write_hgt

pytest.importorskip("sumo", reason="needs the extra 'sumo'")


@pytest.fixture
def town(tmp_path: Path) -> Path:
    path = tmp_path / "town.osm"
    path.write_text(TOWN)
    return path


def built(source: Path, *models: Path, **more: float) -> BuildResult:
    heights = HeightOptions(models, **more)
    return build_network(source, source.with_name("high.net.xml"), heights=heights)


def told(result: BuildResult) -> HeightReport:
    assert result.heights is not None
    return result.heights


def on_the_ground(network: RoadNetwork, raised: tuple[str, ...]) -> NDArray[np.void]:
    rows = [
        network.lane_points(lane)
        for lane in np.flatnonzero(~network.lanes["internal"])
        if network.edge_ids[network.lanes["edge"][lane]] not in raised
    ]
    return np.concatenate(rows)


def off_model(network: RoadNetwork, points: NDArray[np.void], model: Path) -> NDArray[np.float64]:
    assert network.geo is not None
    places = np.stack([points["x"], points["y"]], axis=1)
    return np.abs(points["z"] - HeightModel([model]).at(unproject(places, network.geo))[0])


def plane_of(path: Path) -> list[str]:
    """Return the ids and the x and y of all junctions as written."""
    text = path.read_text()
    nodes = re.findall(r'<junction id="([^"]*)".*? x="([^"]*)" y="([^"]*)"', text)
    return ["/".join(node) for node in nodes]


def test_heights_equal_the_model_and_x_and_y_do_not_change(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This test does not round corners, because points that heights add would change the curves."""
    monkeypatch.setattr(reader, "round_corners", lambda *_: [])
    rolling = plane(0.02, 0.05)
    model = write_geotiff(
        tmp_path / "ground.tif",
        lambda lon, lat: rolling(lon, lat) + 3.0 * np.sin((lon + lat) * 2e3),
    )
    town.write_text(TOWN.replace('<tag k="bridge" v="yes"/>', ""))
    flat = build_network(town, tmp_path / "flat.net.xml")
    assert flat.levels == 0
    assert not read_network(flat.path).points["z"].any()
    town.write_text(TOWN)
    result = built(town, model)
    network = read_network(result.path)
    assert plane_of(result.path) == plane_of(flat.path)
    level = read_network(flat.path)
    for lane, name in enumerate(level.lane_ids):
        high = network.lane_polyline(network.lane_ids.index(name))
        for point in level.lane_polyline(lane)[:, :2]:
            assert np.hypot(*(high[:, :2] - point).T).min() < 1e-9
    points = on_the_ground(network, told(result).raised_edges)
    far = np.abs(points["x"] - np.interp(11.00525, [11.0, 11.013], [0, 968])) > 100.0
    assert off_model(network, points[far], model).max() < 0.05
    assert told(result).places > 1000
    assert result.path.read_text().count("heights licence: not stated") == 1


def test_a_model_in_metres_gives_the_same_heights_as_one_in_degrees(
    town: Path, tmp_path: Path
) -> None:
    """The model is a plane in metres of UTM 32."""
    import pyproj

    motion = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    ground = plane(0.0, 0.05)
    model = write_geotiff(
        tmp_path / "utm.tif",
        lambda x, y: ground(*motion.transform(x, y)),
        (648_500.0, 5_317_500.0, 651_500.0, 5_320_000.0),
        20.0,
        keys=(1024, 0, 1, 1, 1025, 0, 1, 2, 3072, 0, 1, 32632),
    )
    high = read_network(built(town, model).path)
    assert high.points["z"].min() == pytest.approx(500.0, abs=0.2)
    assert high.points["z"].max() == pytest.approx(500.0 + 0.05 * 1000.8, abs=0.3)


def test_a_bridge_clears_the_road_below_and_is_continuous(town: Path, tmp_path: Path) -> None:
    result = built(town, write_geotiff(tmp_path / "flat.tif", plane(0.0, 0.0)))
    network, report = read_network(result.path), told(result)
    assert report.crossings > 0
    # A ramp of 8 % is 62.5 m long, of which 18.5 m are on the bridge. So 44 points are raised at
    # each end.
    assert report.ramp_places == pytest.approx(2 * 2 * 44, abs=8)
    assert report.max_grade <= 0.081
    below = [n for n, name in enumerate(network.lane_ids) if re.match(r"-?14_", name)]
    deck = network.points["z"].max()
    assert max(network.lane_polyline(lane)[:, 2].max() for lane in below) == pytest.approx(500.0)
    assert deck == pytest.approx(500.0 + CLEARANCE_M, abs=0.1)
    for link in network.links:
        before = network.lane_polyline(link["from_lane"])[-1]
        after = network.lane_polyline(link["next_lane"])[0]
        assert abs(before[2] - after[2]) < 0.01 + 0.1 * np.hypot(*(before - after)[:2])


def test_a_bridge_over_a_valley_does_not_follow_the_ground(town: Path, tmp_path: Path) -> None:
    def valley(lon: NDArray[np.float64], lat: NDArray[np.float64]) -> NDArray[np.float64]:
        inside = np.abs(lon - 11.00525) < 0.0002
        depth = 20.0 * np.clip(1.0 - np.abs(lat - 48.004) / 0.003, 0.0, 1.0)
        return 500.0 - np.where(inside, depth, 0.0)

    report = told(built(town, write_geotiff(tmp_path / "valley.tif", valley, step=0.00005)))
    assert report.max_grade < 0.15
    assert report.heights_m[0] < 481.0  # the lower road is in the valley


def test_voids_of_the_model_are_filled_and_counted(town: Path, tmp_path: Path) -> None:
    def dig(heights: NDArray[np.float64]) -> None:
        heights[20:40, 20:40] = np.nan

    model = write_geotiff(tmp_path / "holes.tif", plane(0.0, 0.01), holes=dig)
    result = built(town, model)
    assert told(result).void_cells == 400
    assert 0 < told(result).filled_places < told(result).places / 2
    assert told(result).heights_m[0] > 499.0


@pytest.mark.parametrize(("grade", "steep"), [(0.1, False), (0.2, True)])
def test_roads_over_the_accepted_grade_are_reported(
    town: Path, tmp_path: Path, grade: float, steep: bool
) -> None:
    result = built(town, write_geotiff(tmp_path / "steep.tif", plane(0.0, grade)))
    assert any("(Hill Road): 20.0%" in line for line in told(result).steep) is steep
    assert bool(check_map(result.path).steep_lanes) is steep


def test_roads_over_25_per_cent_are_refused_unless_allowed_or_limited(
    town: Path, tmp_path: Path
) -> None:
    model = write_geotiff(tmp_path / "steep.tif", plane(0.0, 0.3))
    with pytest.raises(MapError, match=r"(?s)30%, more than 25%.*Hill Road.*--limit-grade"):
        built(town, model)
    assert not (tmp_path / "high.net.xml").exists()
    assert told(built(town, model, max_grade=0.4)).max_grade == pytest.approx(0.3, abs=0.01)
    limited = told(built(town, model, limit_grade=0.15))
    assert limited.max_grade <= 0.151
    assert limited.most_smoothed_m > 10.0
    assert check_map(tmp_path / "high.net.xml").max_grade <= 0.152


def test_a_given_origin_is_written_and_read(town: Path, tmp_path: Path) -> None:
    result = build_network(town, tmp_path / "o.net.xml", origin=(48.004, 11.0))
    geo = read_network(result.path).geo
    assert geo is not None
    assert (geo.offset_x_m, geo.offset_y_m) == (0.0, 0.0)
    assert unproject(np.zeros((1, 2)), geo) == pytest.approx(np.array([[11.0, 48.004]]))
    assert result.provenance["origin"] == "latitude 48.004, longitude 11.0"
    assert "ODbL" in result.provenance["licence"]
    assert "OpenStreetMap contributors" in result.provenance["attribution"]
    row = next(row for row in result.defaults if row.guessed == "maxspeed")
    assert (row.kind, row.value, row.used_for) == ("highway.residential", "13.89", row.edges)
    for wrong in ((11.0, 48.004), (95.0, 11.0)):
        with pytest.raises(ConfigError, match="LAT,LON"):
            build_network(town, tmp_path / "w.net.xml", origin=wrong)


def test_a_network_without_heights_can_get_heights_once(town: Path, tmp_path: Path) -> None:
    town.write_text(TOWN.replace('<tag k="bridge" v="yes"/>', ""))
    flat = build_network(town, tmp_path / "flat.net.xml").path
    model = write_hgt(tmp_path / "N48E011.hgt", plane(0.0, 0.05))
    result = built(flat, model)
    assert told(result).raised_edges == ()
    assert "ODbL" in result.provenance["licence"]
    with pytest.raises(MapError, match="has heights already"):
        build_network(result.path, tmp_path / "x.net.xml", heights=HeightOptions((model,)))


def test_bridges_and_tunnels_get_heights_without_a_model_where_they_cross_roads(
    town: Path, tmp_path: Path
) -> None:
    """The lanes lie on two levels, so vehicles on the bridge and below it do not touch."""
    over = build_network(town, tmp_path / "over.net.xml")
    town.write_text(TOWN.replace('"bridge" v="yes"', '"tunnel" v="yes"').replace('v="1"', 'v="-1"'))
    under = build_network(town, tmp_path / "under.net.xml")
    assert over.levels > 0
    assert over.levels == under.levels
    assert over.provenance["levels"].startswith(f"{over.levels} crossings")
    assert plane_of(over.path) == plane_of(under.path)
    for result, sign in ((over, 1.0), (under, -1.0)):
        network = read_network(result.path)
        z_m = sign * network.points["z"]
        assert z_m.max() == pytest.approx(CLEARANCE_M, abs=0.01)
        assert z_m.min() == 0.0
        assert np.abs(network.points["slope"]).max() <= 0.081
        crossed = [n for n, name in enumerate(network.lane_ids) if re.match(r"-?14_", name)]
        assert crossed
        assert not any(network.lane_polyline(lane)[:, 2].any() for lane in crossed)
    with pytest.raises(MapError, match="build the map again"):
        built(over.path, write_hgt(tmp_path / "N48E011.hgt", plane(0.0, 0.05)))


# Way 12 crosses way 14. Way 20 crosses way 12 on a second level, 18.55 m further east.
SECOND_LEVEL_NODES = """\
  <node id="9" lat="48.000" lon="11.0055"/><node id="10" lat="48.0035" lon="11.0055"/>
  <node id="11" lat="48.0045" lon="11.0055"/><node id="12" lat="48.009" lon="11.0055"/>
"""
SECOND_LEVEL_WAYS = """\
  <way id="18"><nd ref="9"/><nd ref="10"/>TAGS</way>
  <way id="19"><nd ref="11"/><nd ref="12"/>TAGS</way>
  <way id="20"><nd ref="10"/><nd ref="11"/>TAGS<tag k="bridge" v="yes"/><tag k="layer" v="2"/></way>
  <way id="21"><nd ref="7"/><nd ref="9"/>TAGS</way>
</osm>
""".replace("TAGS", '<tag k="highway" v="residential"/>')


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["bridges", "tunnels"])
def test_a_second_level_clears_the_raised_first_level(
    town: Path, tmp_path: Path, sign: float
) -> None:
    text = TOWN.replace('lat="48.004" lon="11.0055"', 'lat="48.004" lon="11.0065"')
    text = text.replace('  <way id="10">', SECOND_LEVEL_NODES + '  <way id="10">')
    text = text.replace("</osm>\n", SECOND_LEVEL_WAYS)
    if sign < 0.0:
        text = text.replace('"bridge" v="yes"', '"tunnel" v="yes"')
        text = text.replace('k="layer" v="', 'k="layer" v="-')
    town.write_text(text)
    network = read_network(build_network(town, tmp_path / "levels.net.xml").path)

    def height(lane: str, axis: int, place: float) -> float:
        line = network.lane_polyline(network.lane_ids.index(lane))
        line = line[line[:, axis].argsort()]
        return sign * float(np.interp(place, line[:, axis], line[:, 2]))

    # Ways 11 to 13 are one road to the east, and ways 18 to 21 one road to the north.
    for east in ("11_0", "-13_0"):
        for north in ("21_0", "-19_0"):
            line = network.lane_polyline(network.lane_ids.index(north))
            x = float(line[np.abs(line[:, 1] - 455.0).argmin(), 0])
            # From a height of 5 m above way 14, a ramp of 8 % leads down. The lanes of way 14 are
            # 3 m apart.
            first = height(east, 0, x)
            assert 5.0 - 0.08 * 19.0 < first < 5.0 - 0.08 * 14.0
            assert 4.9 < height(north, 1, 455.0) - first < 5.4


def test_a_bridge_that_crosses_no_road_stays_on_flat_ground(town: Path, tmp_path: Path) -> None:
    way = '<way id="14"><nd ref="7"/><nd ref="8"/>'
    assert way in TOWN
    town.write_text(TOWN.replace(way, '<way id="14"><nd ref="7"/><nd ref="1"/>'))
    result = build_network(town, tmp_path / "flat.net.xml")
    assert result.levels == 0
    assert "levels" not in result.provenance
    assert not read_network(result.path).points["z"].any()


def test_all_lanes_of_a_road_to_a_bridge_have_equal_heights(
    built_map: Callable[[str], Path],
) -> None:
    """This also holds if only one of the lanes leads to the bridge."""
    network = network_of(built_map("osm/monaco.osm.gz"))
    assert network.points["z"].max() > 4.9
    compared = 0
    for lane in np.flatnonzero((network.lanes["left"] >= 0) & ~network.lanes["internal"]).tolist():
        left = int(network.lanes["left"][lane])
        if network.lanes["edge"][left] != network.lanes["edge"][lane]:
            continue
        one, points = network.lane_polyline(lane), network.lane_points(left)
        s_m = np.arange(0.0, points["s"][-1], 0.2)
        x_m, y_m, z_m = (np.interp(s_m, points["s"], points[axis]) for axis in "xyz")
        apart = np.hypot(one[:, :1] - x_m, one[:, 1:2] - y_m)
        is_beside = apart.min(axis=1) < 3.5
        climbs = np.abs(z_m[apart.argmin(axis=1)] - one[:, 2])
        assert (climbs[is_beside] < 0.5).all()
        compared += int(is_beside.sum())
    assert compared > 100


def test_heights_for_a_map_without_a_projection_are_refused(tmp_path: Path) -> None:
    from cavmarl.config.registry import find_entry

    model = write_geotiff(tmp_path / "g.tif", plane(0.0, 0.0))
    source = find_entry("ring") / "map" / "map.net.xml"
    with pytest.raises(MapError, match="no projection"):
        build_network(source, tmp_path / "r.net.xml", heights=HeightOptions((model,)))


@pytest.mark.parametrize(
    ("name", "model", "low", "high"),
    [
        ("monaco.osm.gz", "monaco_srtm3.tif", -5.0, 196.0),
        ("laufamholz.osm.xml", "laufamholz_srtm3.tif", 312.0, 325.0),
    ],
)
def test_heights_and_grades_of_real_maps_are_within_bounds(
    shared_maps: Path, tmp_path: Path, name: str, model: str, low: float, high: float
) -> None:
    heights = HeightOptions((shared_maps / "dem" / model,), limit_grade=0.15)
    result = build_network(shared_maps / "osm" / name, tmp_path / "m.net.xml", heights=heights)
    report, found = told(result), check_map(result.path)
    assert low <= found.elevation_m[0] < found.elevation_m[1] <= high
    assert report.max_grade <= 0.151
    steps = [np.diff(lane.points, axis=0) for lane in NetDocument(result.path).lanes]
    rise, run = np.abs(np.vstack(steps)[:, 2]), np.hypot(*np.vstack(steps)[:, :2].T)
    assert (rise <= 0.151 * run + 0.002).all(), "a grade is above the limit"
    # The reader rounds corners. A curve is shorter than its corner by the factor
    # 2 tan(turn / 2) / turn, but climbs as much, so it is steeper. The sharpest corner on a slope
    # in Monaco turns by less than 100 degrees.
    network = read_network(result.path)
    is_road = ~network.lanes["internal"]
    first, num = network.lanes["first_point"][is_road], network.lanes["num_points"][is_road]
    rows = np.concatenate([np.arange(a, a + n) for a, n in zip(first, num, strict=True)])
    turn = np.radians(100.0)
    assert np.abs(network.points["slope"][rows]).max() <= 0.155 * 2.0 * np.tan(turn / 2.0) / turn
    assert bool(report.raised_edges) is name.startswith("monaco")
