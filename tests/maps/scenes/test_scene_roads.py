"""Networks of logged scenes: connections, rights of way and parallel lanes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl import ConfigError, MapError
from cavmarl.maps.netconvert import build_network, map_file
from cavmarl.maps.scenes.logged_scene import LoggedScene, SceneLane
from cavmarl.maps.scenes.scene_files import read_scene
from cavmarl.maps.scenes.scene_roads import scene_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.logged_scenes import lane_lines, write_json_scene, write_pickle


def network_of(scene: LoggedScene, folder: Path) -> RoadNetwork:
    path = folder / "scene.net.xml"
    path.write_text(scene_network(scene).text, encoding="utf-8")
    return read_network(path)


def scene_of(*lines: list[tuple[float, float]]) -> LoggedScene:
    """Return a scene with lanes along these lines, without stated exits."""
    lanes = [
        SceneLane(str(k), np.array([(x, y, 0.0) for x, y in line]), False, None, None, None)
        for k, line in enumerate(lines)
    ]
    return LoggedScene("drawn", 0.1, lanes, [], [], "", 0, ())


def drawn(*lines: list[tuple[float, float]], folder: Path) -> RoadNetwork:
    return network_of(scene_of(*lines), folder)


def test_stated_and_inferred_exits_of_lanes_give_the_same_crossing(tmp_path: Path) -> None:
    one = network_of(read_scene(write_pickle(tmp_path)), tmp_path)
    other = network_of(read_scene(write_json_scene(tmp_path)), tmp_path)
    for network in (one, other):
        assert len(network.lanes) == 20
        assert network.lanes["internal"].sum() == 12
        letters = "".join(sorted(map(chr, network.links["direction"].tolist())))
        assert letters == "llllrrrrssss"
        assert not network.junctions["unruled"].any()
    assert (one.links["from_lane"] == other.links["from_lane"]).all()
    assert (one.conflicts == other.conflicts).all()


def test_lanes_begin_and_end_where_their_centre_lines_do(tmp_path: Path) -> None:
    network = network_of(read_scene(write_pickle(tmp_path)), tmp_path)
    lines = lane_lines()
    ends = {tuple(np.round(line[[0, -1], :2].ravel(), 2)) for line in lines.values()}
    for lane in range(len(network.lanes)):
        line = network.lane_polyline(lane)
        assert tuple(np.round(line[[0, -1], :2].ravel(), 2)) in ends


def test_exactly_one_of_two_foes_yields(tmp_path: Path) -> None:
    network = network_of(read_scene(write_pickle(tmp_path)), tmp_path)
    yields = set()
    for link, row in enumerate(network.links):
        own = network.conflicts[
            row["first_conflict"] : row["first_conflict"] + row["num_conflicts"]
        ]
        yields |= {(link, int(c["foe"])) for c in own if c["must_yield"]}
    assert yields
    assert not {(foe, link) for link, foe in yields} & yields
    turns = [chr(one) for one in network.links["direction"].tolist()]
    for link, foe in yields:
        assert "srl".index(turns[link]) >= "srl".index(turns[foe])


def test_parallel_lanes_become_one_edge_from_the_right(tmp_path: Path) -> None:
    left, right = [(0.0, 3.5), (100.0, 3.5)], [(0.0, 0.0), (100.0, 0.0)]
    back = [(100.0, 7.0), (0.0, 7.0)]
    network = drawn(left, right, back, folder=tmp_path)
    assert len(network.edges) == 2
    lanes = network.lanes
    pair = np.flatnonzero(lanes["left"] >= 0)
    assert len(pair) == 1
    assert network.lane_polyline(int(pair[0]))[0, 1] == 0.0
    assert network.lane_polyline(int(lanes["left"][pair[0]]))[0, 1] == 3.5


def test_lanes_that_diverge_become_paths_over_junctions(tmp_path: Path) -> None:
    before = [(-100.0, 0.0), (0.0, 0.0)]
    straight, turning = [(0.0, 0.0), (20.0, 0.0)], [(0.0, 0.0), (10.0, -1.0), (20.0, -6.0)]
    after, away = [(20.0, 0.0), (100.0, 0.0)], [(20.0, -6.0), (100.0, -46.0)]
    network = drawn(before, straight, turning, after, away, folder=tmp_path)
    assert network.lanes["internal"].sum() == 2
    assert len(network.links) == 2
    assert (network.links["first_internal"] >= 0).all()


def test_lanes_on_different_levels_do_not_cross(tmp_path: Path) -> None:
    def cross(z: float) -> LoggedScene:
        level = [(-50.0, 0.0, 0.0), (-5.0, 0.0, 0.0), (5.0, 0.0, 0.0), (50.0, 0.0, 0.0)]
        high = [(0.0, -50.0, z), (0.0, -5.0, z), (0.0, 5.0, z), (0.0, 50.0, z)]
        lanes = [
            SceneLane(f"{k}{i}", np.array(line[i : i + 2]), False, None, None, None)
            for k, line in enumerate((level, high))
            for i in range(3)
        ]
        return LoggedScene("drawn", 0.1, lanes, [], [], "", 0, ())

    assert network_of(cross(0.0), tmp_path).lanes["internal"].sum() == 2
    assert network_of(cross(6.0), tmp_path).lanes["internal"].sum() == 0


def test_a_scene_is_built_and_cached_like_other_maps(tmp_path: Path) -> None:
    source = write_json_scene(tmp_path)
    built = build_network(source, tmp_path / "out.net.xml")
    assert built.kind == "scene"
    assert built.provenance["source"] == "made.json"
    assert "20 lanes without width: 3.5 m" in built.notes
    entry = map_file(source)
    assert entry.read_bytes() == built.path.read_bytes()
    assert map_file(source) == entry
    with pytest.raises(ConfigError, match="leave out all options"):
        build_network(source, tmp_path / "cut.net.xml", bbox=(0.0, 0.0, 1.0, 1.0))
    assert not (tmp_path / "cut.net.xml").exists()


def test_lanes_longer_than_the_limit_are_refused(tmp_path: Path) -> None:
    long = [(-1e7, 0.0), (1e7, 0.0)]
    with pytest.raises(MapError, match="longer than 1e"):
        drawn(long, [(0.0, -1e7), (0.0, 1e7)], folder=tmp_path)
    network = drawn([(-1e5, 0.0), (1e5, 0.0)], [(0.0, -1e5), (0.0, 1e5)], folder=tmp_path)
    assert len(network.lanes) == 2
