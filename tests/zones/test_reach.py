"""Reach of drivers, longest move of a vehicle in a tick, and largest distance from its lane."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.rows import LOST_M
from cavmarl.driving.kernels.lanes.lane_index import VIEW_M
from cavmarl.driving.kernels.motion.motion import LATERAL_MPS, MAX_SPEED_MPS
from cavmarl.engine.world_setup import find_map
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.kernels.visibility_scratch import make_scratch
from cavmarl.zones.kernels.visibility_tests import farthest_m, find_looks
from cavmarl.zones.kernels.zone_lookup import LOOK
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.reach import APPROACH_M, ASIDE_M, driving_reach_m, longest_move_m, off_lane_m
from cavmarl.zones.visibility import Visibility
from tests.support.driving import drive, make_traffic, start
from tests.support.netgenerate import netgenerate
from tests.support.traffic import NAMES, network, travel
from tests.support.watchers import looks_of

LENGTH_M = 5.0  # length of generated cars
# Two roads of 40 m; the junction between them has no lanes, so vehicles jump over 20 m.
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
    """Return the largest distance between the stop lines of two conflicting links."""
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
def test_reach_includes_the_view_and_junctions_and_approaching_vehicles(name: str) -> None:
    roads = network(name)
    reach_m = driving_reach_m(roads, travel(name))
    rest_m = reach_m - VIEW_M - APPROACH_M - 2.0 * LENGTH_M - ASIDE_M
    assert widest_junction_m(roads) <= rest_m + 1e-9
    assert rest_m <= 40.0, "the part of the reach for junctions is above 40 m"


def test_reach_shrinks_if_drivers_check_stop_lines_from_a_shorter_distance() -> None:
    near = travel("merge")._replace(see_m=100.0)
    shrunk = driving_reach_m(network("merge"), travel("merge")) - driving_reach_m(
        network("merge"), near
    )
    assert shrunk == pytest.approx(VIEW_M - 100.0)


def test_reach_grows_with_a_view_longer_than_junctions() -> None:
    roads = network("merge")
    blind = travel("merge")._replace(see_m=0.0)
    assert roads.links["length_m"].max() + APPROACH_M < VIEW_M
    grown = driving_reach_m(roads, blind._replace(view_m=2000.0)) - driving_reach_m(roads, blind)
    assert grown == pytest.approx(2000.0 - VIEW_M)


def test_reach_includes_jumps_over_junctions_without_lanes(tmp_path: Path) -> None:
    path = tmp_path / "gap.net.xml"
    path.write_text(GAP, encoding="utf-8")
    roads = load_network(find_map(path))
    reach_m = driving_reach_m(roads, travel("merge"))
    # A road of 40 m and a jump of 20 m: up to 1.5 m of ground per metre of lane. Two of the three
    # jumps are at the ends of the reach, the third is the distance from the lane's end to its exit.
    stretched = 1.5 * (VIEW_M + APPROACH_M) + 3.0 * 20.0
    assert reach_m == pytest.approx(stretched + 2.0 * LENGTH_M + ASIDE_M)


def test_the_longest_move_includes_jumps_over_junctions_without_lanes(tmp_path: Path) -> None:
    path = tmp_path / "gap.net.xml"
    path.write_text(GAP, encoding="utf-8")
    tick_s = 0.1
    driven_m = float(np.hypot(MAX_SPEED_MPS, LATERAL_MPS)) * tick_s
    roads = load_network(find_map(path))
    assert longest_move_m(roads, travel("merge"), tick_s) == pytest.approx(
        driven_m + 20.0 + LENGTH_M / 2
    )
    assert longest_move_m(roads, travel("merge"), 1.0) == pytest.approx(
        10.0 * driven_m + 2.0 * 20.0 + LENGTH_M / 2
    ), "the second jump in a tick of 1 s is missing"


def test_the_longest_move_includes_kinks_of_lanes() -> None:
    roads, tick_s = network("merge"), 0.1
    driven_m = float(np.hypot(MAX_SPEED_MPS, LATERAL_MPS)) * tick_s
    lines = zip(roads.lanes["first_point"], roads.lanes["num_points"], strict=True)
    turns = [
        abs(math.remainder(b - a, math.tau))
        for first, num in lines
        for a, b in pairwise(roads.points["heading"][first : first + num - 1].tolist())
    ]
    aside_m = float(roads.lanes["width_m"].max())
    kink_m = 2.0 * aside_m * math.sin(0.5 * max(turns))
    assert longest_move_m(roads, travel("merge"), tick_s) >= driven_m + kink_m + LENGTH_M / 2 - 1e-9
    assert longest_move_m(roads, travel("merge"), tick_s) < driven_m + aside_m + LENGTH_M / 2


@pytest.mark.parametrize("internal", [(), ("--no-internal-links",)])
def test_no_vehicle_exceeds_the_longest_move(internal: tuple[str, ...], tmp_path: Path) -> None:
    path = netgenerate(
        tmp_path / "x.net.xml",
        "--grid", "--grid.number", "3", "--grid.length", "80", "-L", "3", *internal,
    )  # fmt: skip
    tick_s = 0.1
    simulation = make_traffic(
        path, background=60, overrides={"clock.sim_dt_s": tick_s, "clock.ctrl_dt_s": tick_s}
    )
    start(simulation, seed=1)
    furthest_m = 0.0
    before: dict[int, tuple[float, float]] = {}
    for _ in range(300):
        drive(simulation)
        rows = simulation.vehicles(0)
        now = {int(row["id"]): (float(row["x"]), float(row["y"])) for row in rows}
        for vehicle in now.keys() & before.keys():
            furthest_m = max(furthest_m, math.dist(now[vehicle], before[vehicle]))
        before = now
    assert furthest_m <= longest_move_m(simulation.network, travel("merge"), tick_s)
    assert (furthest_m > MAX_SPEED_MPS * tick_s) == bool(internal)


@pytest.mark.parametrize("internal", [(), ("--no-internal-links",)])
def test_no_vehicle_exceeds_the_distance_off_its_lane(
    internal: tuple[str, ...], tmp_path: Path
) -> None:
    """While a vehicle jumps over a junction, its centre is far from both lanes."""
    path = netgenerate(
        tmp_path / "x.net.xml",
        "--grid", "--grid.number", "3", "--grid.length", "120", "-L", "3", *internal,
    )  # fmt: skip
    simulation = make_traffic(path, background=60)
    start(simulation, seed=1)
    roads = simulation.network
    furthest_m = 0.0
    for _ in range(300):
        drive(simulation)
        for row in simulation.vehicles(0):
            lane = roads.lanes[row["lane"]]
            points = roads.points[lane["first_point"] :][: lane["num_points"]]
            x, y = (np.interp(row["s"], points["s"], points[axis]) for axis in ("x", "y"))
            furthest_m = max(furthest_m, math.dist((x, y), (row["x"], row["y"])))
    assert (furthest_m > LOST_M) == bool(internal)
    assert furthest_m <= off_lane_m(roads, travel("merge"))


def test_a_zone_also_sees_vehicles_beside_the_lanes_that_it_sees(tmp_path: Path) -> None:
    """`seen_m` is the look-ahead of drivers along lanes plus the distance of bodies to lanes."""
    path = netgenerate(
        tmp_path / "x.net.xml",
        "--grid", "--grid.number", "8", "--grid.length", "100", "--no-internal-links",
    )  # fmt: skip
    roads, kinds = load_network(path), travel("merge")
    partition = cut_map(roads, "grid", 4)
    sight = Visibility(roads, kinds, halo_m=1000.0, sure_m=5.0, outside_m=8.0)
    halo = sight.halo(partition)
    seen = [looks_of(halo, zone) for zone in range(4)]
    look_m = max(
        farthest_m(roads.arrays, partition.arrays.rects, zone, looks)
        for zone, looks in enumerate(seen)
    )
    aside_m = off_lane_m(roads, kinds)
    assert aside_m > LOST_M
    assert halo.seen_m == look_m + aside_m < halo.halo_m
    inner = np.isfinite(partition.reaching[:, 2])
    margins = partition.reaching[inner, 2] - halo.inner[inner, 2]
    assert len(margins) == 2
    assert margins == pytest.approx(halo.seen_m, abs=1e-4)
    # A zone's drivers may be up to `outside_m` outside of it, because a transfer may be late.
    wide_m = 8.0 + aside_m
    half_m = 0.5 * float(kinds.types["length"].max())
    scratch = make_scratch(len(roads.lanes), len(roads.links))
    for zone, rect in enumerate(partition.reaching):
        looks = np.zeros(len(roads.lanes), dtype=LOOK)
        wide = rect + np.array([-wide_m, -wide_m, wide_m, wide_m])
        find_looks(roads.arrays, wide, kinds.view_m, kinds.see_m, half_m, scratch, looks)
        assert seen[zone].tolist() == looks.tolist()


def test_without_jumps_the_distance_off_a_lane_is_at_most_lost_m() -> None:
    assert off_lane_m(network("grid4x4"), travel("grid4x4")) == LOST_M
