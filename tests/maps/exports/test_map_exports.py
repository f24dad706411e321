"""Maps that were exported and read again equal the original maps."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from cavmarl.cli.map import app
from cavmarl.core.errors import ConfigError, MapError
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.exports.geojson import write_geojson
from cavmarl.maps.exports.lanelet import FIRST_LIGHT, FIRST_RIGHT, write_lanelet2
from cavmarl.maps.exports.opendrive import write_opendrive
from cavmarl.maps.exports.opendrive_lanes import LANES
from cavmarl.maps.heights.draping import HeightOptions
from cavmarl.maps.netconvert import build_network
from cavmarl.maps.projection import project
from cavmarl.roads.cache import load_network
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.terrain import TOWN, plane, write_geotiff

pytest.importorskip("sumo", reason="needs the extra 'sumo'")


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """Build a town on a slope."""
    source = tmp_path / "town.osm"
    source.write_text(TOWN)
    model = write_geotiff(tmp_path / "ground.tif", plane(0.02, 0.05))
    target = tmp_path / "town.net.xml"
    return build_network(source, target, heights=HeightOptions((model,))).path


def test_an_opendrive_export_equals_the_map_when_it_is_read_again(
    town: Path, tmp_path: Path
) -> None:
    target = tmp_path / "town.xodr"
    trip = write_opendrive(town, target)
    assert trip.same
    assert trip.off < 0.02
    text = target.read_text()
    assert text.count("<elevation ") > 12
    assert "+proj=utm" in text
    assert "generated on" not in text
    back = read_network(build_network(target, tmp_path / "back.net.xml").path)
    heights = read_network(town).points["z"]
    assert back.points["z"].min() == pytest.approx(heights.min(), abs=0.3)
    assert back.points["z"].max() == pytest.approx(heights.max(), abs=0.3)


@pytest.mark.parametrize(
    "name",
    [
        "net/Town10HD.net.xml",
        "net/bologna_acosta/acosta_buslanes.net.xml",
        "net/mcity/mcity.net.xml",  # has merging lanes beside lanes that lead elsewhere
    ],
)
def test_opendrive_exports_of_real_maps_equal_the_maps_when_they_are_read_again(
    shared_maps: Path, tmp_path: Path, name: str
) -> None:
    target = tmp_path / "map.xodr"
    trip = write_opendrive(shared_maps / name, target)
    assert trip.same, trip.problems
    assert trip.off < 0.02
    for road in ElementTree.parse(target).iterfind("road"):
        if road.get("junction") == "-1":
            continue
        ends = [
            [int(one.get("id", "0")) for one in road.iterfind(f"{LANES}/link/{kind}")]
            for kind in ("predecessor", "successor")
        ]
        for ids in ends:  # the linked lanes of both roads have consecutive numbers
            assert ids == list(range(ids[0], ids[0] - len(ids), -1))


def test_geojson_has_each_lane_at_its_position(town: Path, tmp_path: Path) -> None:
    network = read_network(town)
    target = tmp_path / "town.geojson"
    count = write_geojson(network, target, town)
    document = json.loads(target.read_text())
    assert len(document["features"]) == count == int((~network.lanes["internal"]).sum())
    assert "ODbL" in document["provenance"]["licence"]
    for feature in document["features"]:
        line = np.array(feature["geometry"]["coordinates"])
        shape = network.lane_polyline(network.lane_ids.index(feature["id"]))
        assert network.geo is not None
        assert project("it", line[:, :2], network.geo) == pytest.approx(shape[:, :2], abs=0.01)
        assert line[:, 2] == pytest.approx(shape[:, 2], abs=0.001)


def test_lanelets_are_connected_and_lie_on_their_lanes(town: Path, tmp_path: Path) -> None:
    lanelet2 = pytest.importorskip("lanelet2", reason="needs the extra 'lanelet2'")
    network = read_network(town)
    target = tmp_path / "town_lanelets.osm"
    counts = write_lanelet2(network, target)
    assert counts["lanelets"] == counts["read back"] == len(network.lanes)
    longitude, latitude = 11.0, 48.0
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(latitude, longitude))
    back = lanelet2.io.load(str(target), projector)
    by_name = {lanelet.attributes["name"]: lanelet for lanelet in back.laneletLayer}
    ends = lanelet_ends(target)
    for link in network.links:
        chain = [int(link["from_lane"]), int(link["next_lane"])]
        while network.lanes["internal"][chain[-1]]:
            chain.append(int(network.lanes["successor"][chain[-1]]))
        names = [network.lane_ids[lane] for lane in chain]
        for one, other in itertools.pairwise(names):
            assert ends[one][1] == ends[other][0], (one, other)
            # lanelet2 reverses lanelets whose borders cross, such as tight U-turns
            if link["direction"] == ord("s"):
                assert lanelet2.geometry.follows(by_name[one], by_name[other])
    # the borders lie beside their lanes
    for lane, name in enumerate(network.lane_ids):
        if network.lanes["internal"][lane]:
            continue
        shape = network.lane_polyline(lane)
        for n in (0, -1):
            bounds = [by_name[name].leftBound[n], by_name[name].rightBound[n]]
            places = [
                [float(point.attributes[key]) for key in ("local_x", "local_y")] for point in bounds
            ]
            assert np.hypot(*(np.mean(places, axis=0) - shape[n, :2])) < 0.5, name


def lanelet_ends(path: Path) -> dict[str, list[list[str | None]]]:
    """Return the two points at the start and the two at the end of each lanelet, by name."""
    root = ElementTree.parse(path).getroot()
    ways = {way.get("id"): [nd.get("ref") for nd in way.iter("nd")] for way in root.iter("way")}
    found = {}
    for relation in root.iter("relation"):
        tags = {tag.get("k"): tag.get("v") for tag in relation.iter("tag")}
        if tags["type"] == "lanelet":
            bounds = {one.get("role"): ways.get(one.get("ref")) for one in relation.iter("member")}
            left, right = bounds["left"], bounds["right"]
            assert left is not None
            assert right is not None
            found[str(tags["name"])] = [[left[n], right[n]] for n in (0, -1)]
    return found


def test_lanelets_have_lights_rights_of_way_and_turns(tmp_path: Path) -> None:
    lanelet2 = pytest.importorskip("lanelet2", reason="needs the extra 'lanelet2'")
    network = load_network(find_map("town"))
    links, lanes = network.links, network.lanes
    target = tmp_path / "town.osm"
    counts = write_lanelet2(network, target)
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(52.4, 13.5))
    back = lanelet2.io.load(str(target), projector)
    by_name = {one.attributes["name"]: one for one in back.laneletLayer}
    rules = {one.id: one for one in back.regulatoryElementLayer}
    lights = [n for n, link in enumerate(links) if link["signal"] >= 0]
    assert {id for id in rules if id < FIRST_RIGHT} == {FIRST_LIGHT + n for n in lights}
    for n in lights[:20]:
        own = by_name[network.lane_ids[links["first_internal"][n]]]
        (light,) = (one for one in own.trafficLights() if one.id == FIRST_LIGHT + n)
        end = network.lane_polyline(links["from_lane"][n])[-1]
        ends = [(float(p.attributes["local_x"]), float(p.attributes["local_y"]), p.z)
                for p in light.stopLine]  # fmt: skip
        # the stop line is at the end of the preceding lane, with the light above it
        np.testing.assert_allclose(np.mean(ends, axis=0)[:2], end[:2], atol=0.3)
        assert math.dist(*(each[:2] for each in ends)) == pytest.approx(
            lanes["width_m"][links["from_lane"][n]], abs=0.6
        )
        assert [p.z for p in light.trafficLights[0]] == pytest.approx(
            [each[2] + 5.0 for each in ends], abs=0.01
        )
    rights = [one for id, one in rules.items() if id >= FIRST_RIGHT]
    assert counts["rules"] == len(lights) + len(rights) == len(rules)
    assert rights
    for rule in [one for one in rights if links["signal"][one.id - FIRST_RIGHT] < 0][:50]:
        n = rule.id - FIRST_RIGHT
        conflicts = network.conflicts[links["first_conflict"][n] :][: links["num_conflicts"][n]]
        foes = links["first_internal"][conflicts["foe"][conflicts["must_yield"]]]
        names = {one.attributes["name"] for one in rule.rightOfWayLanelets()}
        assert names == {network.lane_ids[foe] for foe in foes}
        (own,) = rule.yieldLanelets()
        assert own.attributes["name"] == network.lane_ids[links["first_internal"][n]]
    turns = {"s": "straight", "l": "left", "t": "left", "r": "right", "L": "left", "R": "right"}
    for link in links:
        lane = by_name[network.lane_ids[link["first_internal"]]]
        assert lane.attributes["turn_direction"] == turns[chr(link["direction"])]
        assert "turn_direction" not in by_name[network.lane_ids[link["to_lane"]]].attributes


def test_the_command_exports_a_map_folder_for_autoware(town: Path, tmp_path: Path) -> None:
    pytest.importorskip("lanelet2", reason="needs the extra 'lanelet2'")
    folder = tmp_path / "maps" / "town"
    result = CliRunner().invoke(app, ["export", str(town), "--autoware", str(folder)])
    assert result.exit_code == 0, result.output
    assert (folder / "map_projector_info.yaml").read_text() == "projector_type: Local\n"
    assert 'k="turn_direction"' in (folder / "lanelet2_map.osm").read_text()
    words = ["export", str(town), "--autoware", str(folder), "--lanelet2", "x.osm"]
    refused = CliRunner().invoke(app, words)
    assert isinstance(refused.exception, ConfigError)


def test_a_map_folder_for_autoware_needs_no_georeference(tmp_path: Path) -> None:
    lanelet2 = pytest.importorskip("lanelet2", reason="needs the extra 'lanelet2'")
    network = load_network(find_map("grid4x4"))
    result = CliRunner().invoke(app, ["export", "grid4x4", "--autoware", str(tmp_path)])
    assert result.exit_code == 0, result.output
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(45.0, 3.0))
    back = lanelet2.io.load(str(tmp_path / "lanelet2_map.osm"), projector)
    assert len(back.laneletLayer) == len(network.lanes)
    for lanelet in back.laneletLayer:
        lane = network.lane_ids.index(lanelet.attributes["name"])
        ends = [
            [(float(p.attributes["local_x"]), float(p.attributes["local_y"])) for p in bound]
            for bound in (lanelet.leftBound, lanelet.rightBound)
        ]
        shape = network.lane_polyline(lane)
        for place, n in ((shape[0], 0), (shape[-1], -1)):
            middle = np.mean([ends[0][n], ends[1][n]], axis=0)
            np.testing.assert_allclose(middle, place[:2], atol=0.3)
    # neighbour lanes share a border
    by_name = {lanelet.attributes["name"]: lanelet for lanelet in back.laneletLayer}
    lefts = np.flatnonzero(~network.lanes["internal"] & (network.lanes["left"] >= 0))
    pairs = [(lane, int(network.lanes["left"][lane])) for lane in lefts.tolist()]
    sides = [
        lanelet2.geometry.leftOf(*(by_name[network.lane_ids[each]] for each in (left, lane)))
        for lane, left in pairs
    ]
    assert len(pairs) == 80
    assert all(sides)
    # at signals, only left turns yield, namely to straight links
    rights = [one for one in back.regulatoryElementLayer if one.id >= FIRST_RIGHT]
    yields = network.links[np.array([one.id - FIRST_RIGHT for one in rights])]
    assert set(map(chr, yields["direction"])) == {"l"}
    for rule in rights:
        own = network.links["first_internal"][rule.id - FIRST_RIGHT]
        assert rule.yieldLanelets()[0].attributes["name"] == network.lane_ids[own]
        for foe in rule.rightOfWayLanelets():
            assert foe.attributes["turn_direction"] == "straight"


def test_the_command_exports_opendrive_and_geojson(town: Path, tmp_path: Path) -> None:
    xodr, lanes = tmp_path / "a.xodr", tmp_path / "a.geojson"
    words = ["export", str(town), "--opendrive", str(xodr), "--geojson", str(lanes)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert xodr.exists()
    assert lanes.exists()
    refused = CliRunner().invoke(app, ["export", str(town)])
    assert isinstance(refused.exception, ConfigError)


def test_maps_without_a_projection_cannot_be_exported_in_degrees(tmp_path: Path) -> None:
    from cavmarl.config.registry import find_entry

    path = find_entry("ring") / "map" / "map.net.xml"
    with pytest.raises(MapError, match="no georeference"):
        write_geojson(read_network(path), tmp_path / "r.geojson", path)
    with pytest.raises(MapError, match="no georeference"):
        write_lanelet2(read_network(path), tmp_path / "r.osm")
