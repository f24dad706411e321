"""Which maps draw roads over one another, or lanes on which nobody can change."""

from __future__ import annotations

from pathlib import Path

from cavmarl.maps.map_features import MAP_FEATURES, map_features
from cavmarl.maps.shared_ground import shared_ground, stub_lanes
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.netgenerate import netgenerate

GRID = ("--grid", "--grid.number=3", "--grid.length=80")


def test_a_plain_grid_falls_under_no_rule(tmp_path: Path) -> None:
    network = read_network(netgenerate(tmp_path / "grid.net.xml", *GRID, "-L", "2"))
    assert map_features(network) == ()


def test_both_directions_on_one_lane_share_their_ground(tmp_path: Path) -> None:
    spread = "--default.spreadtype=center"
    network = read_network(netgenerate(tmp_path / "bidi.net.xml", *GRID, spread))
    pairs = shared_ground(network)
    assert pairs
    for one, other in pairs:
        assert network.lanes["edge"][one] != network.lanes["edge"][other]
    assert map_features(network) == ("shared_ground",)


def test_turn_lanes_shorter_than_a_car_are_stubs(tmp_path: Path) -> None:
    turns = ("--turn-lanes=1", "--turn-lanes.length=3")
    network = read_network(netgenerate(tmp_path / "stubs.net.xml", *GRID, *turns))
    stubs = stub_lanes(network)
    assert stubs.size
    assert (network.lanes["length_m"][stubs] < 5.0).all()
    assert "stub_lanes" in map_features(network)
    assert {"stub_lanes", "shared_ground", "circular_priority"} == MAP_FEATURES
