"""Networks with contraflow lanes, which lead against the direction of a road."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.contraflow import contraflow_network
from cavmarl.maps.provenance import read_provenance
from cavmarl.roads.network import CARS
from cavmarl.roads.sumo_net.reader import read_network

ROADS = ("B1B2", "C1B1")


def test_contraflow_lanes_lie_on_the_road_in_the_opposite_direction() -> None:
    path = contraflow_network(find_map("grid4x4"), ROADS)
    assert read_provenance(path)["contraflow"] == "B1B2 C1B1"
    network = read_network(path)
    lanes, points = network.lanes, network.points
    for road in ROADS:
        edge, back = (network.edge_ids.index(name) for name in (road, f"contraflow:{road}"))
        assert network.edges["from_junction"][edge] == network.edges["to_junction"][back]
        below, above = (np.flatnonzero(lanes["edge"] == row) for row in (edge, back))
        assert len(below) == len(above)
        assert (lanes["permissions"][above] == 0).all()
        assert (lanes["num_links"][above] > 0).all()
        assert (lanes["num_into"][above] > 0).all()
        for one, other in zip(below, above[::-1], strict=True):
            first, last = lanes["first_point"][one], lanes["first_point"][other]
            end = points[last + lanes["num_points"][other] - 1]
            assert np.hypot(points["x"][first] - end["x"], points["y"][first] - end["y"]) < 0.1


def test_contraflow_lanes_obey_the_signals_of_the_adjacent_road() -> None:
    network = read_network(contraflow_network(find_map("grid4x4"), ROADS))
    ids = network.lane_ids
    ends = {(ids[row["from_lane"]], ids[row["to_lane"]]): row for row in network.links}
    beside, back = ends["B2B1_1", "B1B0_1"], ends["contraflow:B1B2_1", "B1B0_1"]
    assert back["signal"] == beside["signal"] >= 0
    assert back["signal_index"] == beside["signal_index"]


def test_other_lanes_do_not_change() -> None:
    plain = read_network(find_map("grid4x4"))
    network = read_network(contraflow_network(find_map("grid4x4"), ROADS))
    rows = {name: row for row, name in enumerate(network.lane_ids)}
    for row, name in zip(plain.lanes, plain.lane_ids, strict=True):
        if not row["internal"]:
            other = network.lanes[rows[name]]
            assert other["permissions"] == row["permissions"]
            assert other["length_m"] == pytest.approx(row["length_m"], abs=1e-6)
    assert (plain.lanes["permissions"] & CARS != 0).any()


def test_a_network_with_contraflow_lanes_is_cached() -> None:
    path = contraflow_network(find_map("grid4x4"), ROADS)
    made = path.stat().st_mtime_ns
    assert contraflow_network(find_map("grid4x4"), ROADS[::-1]) == path
    assert path.stat().st_mtime_ns == made


@pytest.mark.parametrize("road", ["Z9", ":B1_0", ""])
def test_roads_that_do_not_exist_are_refused(road: str) -> None:
    with pytest.raises(ConfigError, match=r"map\.contraflow: the map has no road"):
        contraflow_network(find_map("grid4x4"), [road])
