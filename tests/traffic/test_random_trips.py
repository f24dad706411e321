"""Random demand: connected routes of a minimum length, determined by the seed."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from cavmarl.cli import main
from cavmarl.config.registry import find_entry
from cavmarl.core.errors import ConfigError, RouteError
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.random_trips import RandomTrips, write_random_demand


@pytest.fixture(scope="module")
def grid() -> RoadNetwork:
    return read_network(find_entry("grid4x4") / "map" / "map.net.xml")


def turns(network: RoadNetwork) -> set[tuple[int, int]]:
    """Return pairs of edges that a link joins, without U-turns."""
    links, edge = network.links[network.links["direction"] != ord("t")], network.lanes["edge"]
    return set(zip(edge[links["from_lane"]].tolist(), edge[links["to_lane"]].tolist(), strict=True))


def test_routes_connect_without_turning_round_and_are_long_enough(grid: RoadNetwork) -> None:
    trips, joined = RandomTrips(grid, seed=3), turns(grid)
    for _ in range(20):
        route = trips.route(2000.0)
        assert set(pairwise(route)) <= joined
        assert grid.edges["length_m"][route].sum() >= 2000.0


def test_each_leg_is_a_shortest_way(grid: RoadNetwork) -> None:
    trips = RandomTrips(grid, seed=1)
    route = trips.route(0.0)
    lengths, joined = grid.edges["length_m"], turns(grid)
    shortest = {route[0]: 0.0}
    for _ in range(len(grid.edges)):  # the Bellman-Ford algorithm
        for before, after in joined:
            if before in shortest:
                way = shortest[before] + float(lengths[after])
                shortest[after] = min(way, shortest.get(after, np.inf))
    assert lengths[route[1:]].sum() == pytest.approx(shortest[route[-1]])


def test_a_file_is_written_and_depends_on_the_seed(grid: RoadNetwork, tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.rou.xml" for k in range(3)]
    for path, seed in zip(files, (5, 5, 6), strict=True):
        write_random_demand(grid, path, vehicles=8, within_s=4.0, route_m=500.0, seed=seed)
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()
    vehicles = ElementTree.parse(files[0]).getroot().findall("vehicle")
    assert [float(v.attrib["depart"]) for v in vehicles] == [0.5 * k for k in range(8)]
    for vehicle in vehicles:
        route = vehicle.find("route")
        assert route is not None
        assert set(route.attrib["edges"].split()) <= set(grid.edge_ids)


def test_a_map_without_a_circuit_is_refused() -> None:
    merge = read_network(find_entry("merge") / "map" / "map.net.xml")
    with pytest.raises(RouteError, match="without a U-turn"):
        RandomTrips(merge, seed=0)


@pytest.mark.parametrize("wrong", [{"vehicles": 0}, {"within_s": -1.0}, {"route_m": float("nan")}])
def test_numbers_out_of_range_are_refused(
    grid: RoadNetwork, tmp_path: Path, wrong: dict[str, float]
) -> None:
    asked = {"vehicles": 1, "within_s": 1.0, "route_m": 1.0, "seed": 0} | wrong
    with pytest.raises(ConfigError, match=next(iter(wrong)).split("_")[0]):
        write_random_demand(grid, tmp_path / "a.rou.xml", **asked)  # type: ignore[arg-type]


def test_the_command_writes_a_demand_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.rou.xml"
    with pytest.raises(SystemExit) as ended:
        main(("demand", "random", "grid4x4", "--vehicles", "3", "--out", str(path)))
    assert not ended.value.code
    assert "3 vehicles" in capsys.readouterr().out
    assert path.read_text().count("<vehicle ") == 3
