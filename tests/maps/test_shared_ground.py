"""Detection of maps with overlapping roads or with lanes too short for a lane change."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.map_features import MAP_FEATURES, map_features, stub_lanes
from cavmarl.maps.defects import find_defects
from cavmarl.maps.shared_ground import shared_ground
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net import reader
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.netgenerate import netconvert, netgenerate

GRID = ("--grid", "--grid.number=3", "--grid.length=80")


def test_a_plain_grid_has_no_unusual_feature(tmp_path: Path) -> None:
    network = read_network(netgenerate(tmp_path / "grid.net.xml", *GRID, "-L", "2"))
    assert map_features(network) == ()


def test_directions_on_the_same_strip_share_their_ground(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test disables the repair by which the reader of networks moves such lanes apart."""
    monkeypatch.setattr(reader, "find_strips", lambda *_: [])
    spread = "--default.spreadtype=center"
    network = read_network(netgenerate(tmp_path / "bidi.net.xml", *GRID, spread))
    pairs = shared_ground(network)
    assert pairs
    for one, other in pairs:
        assert network.lanes["edge"][one] != network.lanes["edge"][other]
    assert map_features(network) == ("shared_ground",)


@pytest.mark.parametrize(("apart_m", "meet"), [(2.0, True), (12.0, False)])
def test_close_junctions_share_the_ground_of_their_internal_lanes(
    tmp_path: Path, apart_m: float, meet: bool
) -> None:
    """One bend leads from west to south, the other one, close to it, from east to north."""
    far = 60.0 + apart_m
    nodes = {"b": (apart_m, apart_m), "e": (far, apart_m), "n": (apart_m, far)}
    network = bend_beside(tmp_path, nodes, ("eb", "be", "bn", "nb"))
    pairs = shared_ground(network)
    assert bool(pairs) == meet
    for pair in pairs:
        assert network.lanes["internal"][list(pair)].any()


@pytest.mark.parametrize(("apart_m", "meet"), [(0.0, True), (12.0, False)])
def test_a_road_over_a_junction_shares_ground_with_the_junction(
    tmp_path: Path, apart_m: float, meet: bool
) -> None:
    """The road passes a bend on the outer side of the bend."""
    nodes = {"b": (20.0 + apart_m, -20.0 + apart_m), "e": (-20.0 + apart_m, 20.0 + apart_m)}
    network = bend_beside(tmp_path, nodes, ("be",))
    inside = network.lanes["internal"]
    pairs = shared_ground(network)
    assert bool(pairs) == meet
    for one, other in pairs:
        assert inside[one] != inside[other]


@pytest.mark.parametrize(("height_m", "is_named"), [(0.0, True), (5.0, False)])
def test_a_road_that_crosses_another_road_at_its_height_is_a_defect(
    tmp_path: Path, height_m: float, is_named: bool
) -> None:
    nodes = {"a": (-60.0, 0.0, 0.0), "b": (60.0, 0.0, 0.0)}
    nodes |= {"c": (0.0, -60.0, height_m), "d": (0.0, 60.0, height_m)}
    points = "".join(
        f'<node id="{name}" x="{x}" y="{y}" z="{z}"/>' for name, (x, y, z) in nodes.items()
    )
    lines = "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="2"/>' for a, b in ("ab", "cd")
    )
    (tmp_path / "over.nod.xml").write_text(f"<nodes>{points}</nodes>")
    (tmp_path / "over.edg.xml").write_text(f"<edges>{lines}</edges>")
    (tmp_path / "over.con.xml").write_text("<connections/>")
    path = netconvert(tmp_path, "over")
    found = [one for one in find_defects(read_network(path), path) if "ground" in one.kind]
    assert [one.kind for one in found] == ["roads on shared ground"] * is_named
    for one in found:
        assert (one.name[:2], one.about[:7]) == ("ab", "with cd")
        assert abs(one.x_m - 60.0) < 5.0  # netconvert moves the origin to the lower left corner
        assert abs(one.y_m - 60.0) < 5.0


def bend_beside(
    tmp_path: Path, nodes: dict[str, tuple[float, float]], others: tuple[str, ...]
) -> RoadNetwork:
    """Build a bend from west to south at the origin, and the roads `others` between nodes."""
    nodes = {"a": (0.0, 0.0), "w": (-60.0, 0.0), "s": (0.0, -60.0), **nodes}
    roads = ("wa", "aw", "as", "sa", *others)
    points = "".join(f'<node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in nodes.items())
    lines = "".join(f'<edge id="{a}{b}" from="{a}" to="{b}"/>' for a, b in roads)
    (tmp_path / "bends.nod.xml").write_text(f"<nodes>{points}</nodes>")
    (tmp_path / "bends.edg.xml").write_text(f"<edges>{lines}</edges>")
    (tmp_path / "bends.con.xml").write_text("<connections/>")
    return read_network(netconvert(tmp_path, "bends"))


def test_turn_lanes_shorter_than_a_car_are_stubs(tmp_path: Path) -> None:
    turns = ("--turn-lanes=1", "--turn-lanes.length=3")
    network = read_network(netgenerate(tmp_path / "stubs.net.xml", *GRID, *turns))
    stubs = stub_lanes(network)
    assert stubs.size
    assert (network.lanes["length_m"][stubs] < 5.0).all()
    assert "stub_lanes" in map_features(network)
    assert {"stub_lanes", "shared_ground", "circular_priority"} == MAP_FEATURES
