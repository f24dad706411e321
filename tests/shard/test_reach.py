"""How far drivers look, as declared: no less than what they look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.kernels.lanes import VIEW_M
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.shard.reach import APPROACH_M, ASIDE_M, driving_reach_m
from cavmarl.worlds import find_map
from tests.kernels.traffic import NAMES, network, travel

LENGTH_M = 5.0  # of the generator's cars
# Two roads of 40 m and a gap of 20 m between them, which vehicles jump over.
GAP = """<?xml version="1.0" encoding="UTF-8"?>
<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,0,0" origBoundary="0,0,0,0" projParameter="!"/>
  <edge id="a" from="W" to="M">
    <lane id="a_0" index="0" speed="14" length="40" shape="0,0,0 40,0,0"/>
  </edge>
  <edge id="b" from="M" to="E">
    <lane id="b_0" index="0" speed="14" length="40" shape="60,0,0 100,0,0"/>
  </edge>
  <junction id="W" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>
  <junction id="M" type="priority" x="50" y="0" incLanes="a_0" intLanes="" shape="">
    <request index="0" response="0" foes="0" cont="0"/>
  </junction>
  <junction id="E" type="dead_end" x="100" y="0" incLanes="b_0" intLanes="" shape=""/>
  <connection from="a" to="b" fromLane="0" toLane="0" dir="s" state="M"/>
</net>"""


def widest_junction_m(roads: RoadNetwork) -> float:
    """Between the ends of lanes whose paths conflict, pair by pair."""
    widest = 0.0
    for link in roads.links:
        first = int(link["first_conflict"])
        for conflict in roads.conflicts[first : first + int(link["num_conflicts"])]:
            places = []
            for one in (link, roads.links[conflict["foe"]]):
                lane = roads.lanes[one["from_lane"]]
                point = roads.points[lane["first_point"] + lane["num_points"] - 1]
                places.append(np.array([point["x"], point["y"]]))
            widest = max(widest, float(np.linalg.norm(places[0] - places[1])))
    return widest


@pytest.mark.parametrize("name", NAMES)
def test_reach_covers_view_junction_and_those_who_come_to_it(name: str) -> None:
    roads = network(name)
    reach_m = driving_reach_m(roads, travel(name))
    rest_m = reach_m - VIEW_M - APPROACH_M - 2.0 * LENGTH_M - ASIDE_M
    assert widest_junction_m(roads) <= rest_m + 1e-9
    assert rest_m <= 40.0, "no halo of a whole map"


def test_reach_shrinks_with_how_far_lines_are_seen() -> None:
    near = travel("merge")._replace(see_m=100.0)
    shrunk = driving_reach_m(network("merge"), travel("merge")) - driving_reach_m(
        network("merge"), near
    )
    assert shrunk == pytest.approx(VIEW_M - 100.0)


def test_reach_grows_with_a_view_beyond_the_junctions() -> None:
    roads = network("merge")
    blind = travel("merge")._replace(see_m=0.0)
    assert roads.links["length_m"].max() + APPROACH_M < VIEW_M
    grown = driving_reach_m(roads, blind._replace(view_m=2000.0)) - driving_reach_m(roads, blind)
    assert grown == pytest.approx(2000.0 - VIEW_M)


def test_jumps_over_junctions_without_lanes_count(tmp_path: Path) -> None:
    path = tmp_path / "gap.net.xml"
    path.write_text(GAP, encoding="utf-8")
    roads = load_network(find_map(path))
    reach_m = driving_reach_m(roads, travel("merge"))
    stretched = 1.5 * (VIEW_M + APPROACH_M) + 3.0 * 20.0
    assert reach_m == pytest.approx(stretched + 2.0 * LENGTH_M + ASIDE_M)
