"""Routes of trips on an empty map are as fast as duarouter's; routes with loops are reported."""

from __future__ import annotations

import random
import subprocess
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import defusedxml.ElementTree
import numpy as np
import pytest

from cavmarl.core.errors import RouteError
from cavmarl.engine.world_setup import find_map
from cavmarl.evaluate.traffic.native_side import make_world
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.trip_ways import TripWays
from tests.support.netgenerate import netgenerate

sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")

TRIP = '<trip id="{k}" type="car" depart="0" from="{start}" to="{goal}"/>'
GRID = "--grid --grid.number=4 --grid.length=70 --turn-lanes=1 --turn-lanes.length=25 -L=2"


def duarouter(folder: Path, net: Path, pairs: Sequence[tuple[str, str]]) -> list[list[str] | None]:
    """Return the edges of each of duarouter's routes, or None where no route exists."""
    trips, routes = folder / "d.trips.xml", folder / "d.rou.xml"
    rows = (TRIP.format(k=k, start=start, goal=goal) for k, (start, goal) in enumerate(pairs))
    trips.write_text(f'<routes><vType id="car" maxSpeed="99"/>{"".join(rows)}</routes>')
    tool = Path(sumo.SUMO_HOME) / "bin" / "duarouter"
    options = [
        "--weights.minor-penalty=0",
        "--xml-validation=never",
        "--no-step-log",
        "--ignore-errors",
    ]
    command = [tool, "-n", net, "-r", trips, "-o", routes, *options]
    subprocess.run([str(word) for word in command], check=True, capture_output=True)
    found = defusedxml.ElementTree.parse(routes).iter("vehicle")
    by_id = {one.get("id"): str(one.find("route").get("edges")).split() for one in found}
    return [by_id.get(str(k)) for k in range(len(pairs))]


def time_s(roads: RoadNetwork, edges: Sequence[int]) -> float:
    """Return the time of a route at the speed limits, without lane changes."""
    lanes, links = roads.lanes, roads.links
    time = lanes["length_m"] / lanes["speed_mps"]
    total = sum(float(time[lanes["edge"] == edge].min()) for edge in edges)
    ends = lanes["edge"][links["from_lane"]], lanes["edge"][links["to_lane"]]
    for edge, following in pairwise(edges):
        over = []
        for link in np.flatnonzero((ends[0] == edge) & (ends[1] == following)):
            inside = lanes["link"] == link
            over.append(float(time[inside & lanes["internal"]].sum()))
        total += min(over)
    return total


@pytest.mark.parametrize("name", ["grid4x4", "town", "turn lanes", "one lane"])
def test_no_route_is_slower_than_the_route_of_duarouter(name: str, tmp_path: Path) -> None:
    options = {"turn lanes": GRID, "one lane": "--rand --rand.iterations=40 -L=1"}
    if name in options:
        net = netgenerate(tmp_path / "made.net.xml", *options[name].split(), "--seed=3")
    else:
        net = find_map(name)
    roads, chance = read_network(net), random.Random(1)
    edges = np.flatnonzero(~roads.edges["internal"]).tolist()
    pairs = [tuple(chance.sample(edges, 2)) for _ in range(80)]
    names = roads.edge_ids
    theirs = duarouter(tmp_path, net, [(names[start], names[goal]) for start, goal in pairs])
    ways = TripWays(roads)
    assert sum(other is not None for other in theirs) > 20
    for pair, other in zip(pairs, theirs, strict=True):
        if other is None:
            with pytest.raises(RouteError, match="no route"):
                ways.edges(np.array(pair, dtype=np.int32), CARS)
            continue
        own = ways.edges(np.array(pair, dtype=np.int32), CARS).tolist()
        limit = time_s(roads, [names.index(edge) for edge in other])
        assert time_s(roads, own) < limit + 1e-3, [names[edge] for edge in own]


def test_routes_that_pass_a_junction_twice_are_reported(tmp_path: Path) -> None:
    net = netgenerate(tmp_path / "grid.net.xml", "--grid", "--grid.number=2", "-L=1")
    demand = tmp_path / "x.rou.xml"
    demand.write_text(
        '<routes><route id="round" edges="A0A1 A1B1 B1B0 B0A0 A0A1 A1B1"/>'
        '<vehicle id="loops" route="round" depart="0"/>'
        '<vehicle id="too" route="round" depart="1"/>'
        '<trip id="straight" from="A0A1" to="A1B1" depart="2"/></routes>'
    )
    for _ in range(2):
        world = make_world(net, [demand], 10, 1, 0.1)
    assert isinstance(world.demand, DemandFile)
    (line,) = world.demand.report.lines()
    assert line.strip() == f"1 route passes a junction twice (first: {demand}, line 1)"
