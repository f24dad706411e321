"""The parts of lanes that drivers of a zone look at, compared with a slow twin (`Looks`).

A twin is a second, simple implementation that tests positions on lanes one by one.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.rows import MERGES_M
from cavmarl.driving.kernels.junctions.stop_line_registration import APPROACH_M
from cavmarl.driving.steered_sweeps import load_steered
from cavmarl.engine.world_setup import find_map
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.zones.kernels.visibility_scratch import make_scratch
from cavmarl.zones.kernels.visibility_tests import ASIDE_M, ROUNDING_M, farthest_m, find_looks
from cavmarl.zones.kernels.zone_lookup import LOOK
from tests.naive.looks import STEP_M, Looks
from tests.support.junction_scenes import build_crossing, with_shorter_lane
from tests.support.netgenerate import netgenerate
from tests.support.traffic import network

VIEW_M, SEE_M, HALF_M = 90.0, 40.0, 6.0
# Three consecutive roads of 400 m; at their junctions, no drivers yield.
LINE = """<?xml version="1.0" encoding="UTF-8"?>
<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,0,0" origBoundary="0,0,0,0" projParameter="!"/>
  {edges}
  <junction id="j0" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>
  <junction id="j1" type="priority" x="400" y="0" incLanes="e0_0" intLanes="" shape="">
    <request index="0" response="0" foes="0" cont="0"/>
  </junction>
  <junction id="j2" type="priority" x="800" y="0" incLanes="e1_0" intLanes="" shape="">
    <request index="0" response="0" foes="0" cont="0"/>
  </junction>
  <junction id="j3" type="dead_end" x="1200" y="0" incLanes="e2_0" intLanes="" shape=""/>
  <connection from="e0" to="e1" fromLane="0" toLane="0" dir="s" state="M"/>
  <connection from="e1" to="e2" fromLane="0" toLane="0" dir="s" state="M"/>
</net>"""
EDGE = """<edge id="e{n}" from="j{n}" to="j{end}">
    <lane id="e{n}_0" index="0" speed="14" length="400" shape="{start},0,0 {stop},0,0"/>
  </edge>"""


def looks_of(
    roads: RoadNetwork, rect: tuple[float, float, float, float], half_m: float = HALF_M
) -> NDArray[np.void]:
    looks = np.zeros(len(roads.lanes), dtype=LOOK)
    scratch = make_scratch(len(roads.lanes), len(roads.links))
    for _ in range(2):  # the second call finds used scratch arrays
        find_looks(roads.arrays, np.array(rect), VIEW_M, SEE_M, half_m, scratch, looks)
    return looks


def same_looks(found: NDArray[np.void], twin: Looks) -> None:
    """Check that all parts are equal; the twin tests positions on lanes with a step of STEP_M."""
    for field, told in (
        ("head", twin.head),
        ("tail", twin.tail),
        ("back", twin.back),
        ("line", twin.line),
        ("room", twin.room),
        ("merge", twin.merge),
    ):
        expected = np.array([told[lane] for lane in range(len(found))])
        np.testing.assert_allclose(found[field], expected, atol=2.0 * STEP_M, err_msg=field)


@pytest.mark.parametrize("name", ["merge", "grid4x4"])
@pytest.mark.parametrize(
    "part", [(0.0, 0.0, 0.4, 1.0), (0.3, 0.45, 0.8, 0.7), (0.5, 0.5, 0.6, 0.6)]
)
@pytest.mark.parametrize("half_m", [2.5, HALF_M])
@pytest.mark.parametrize("steered", [False, True])
def test_the_kernel_equals_its_twin(
    name: str, part: tuple[float, float, float, float], half_m: float, steered: bool
) -> None:
    # A map from `load_steered` also has the areas that steered cars sweep: cars of agents, whose
    # bumpers are not always on their path. These areas come from a cache, because computing them
    # takes minutes without the compiler.
    roads = load_steered(find_map(name)) if steered else network(name)
    min_x, min_y, max_x, max_y = roads.extent_m
    low, high = np.array([min_x, min_y] * 2), np.array([max_x, max_y] * 2)
    rect = tuple((low + np.array(part) * (high - low)).tolist())
    found, twin = looks_of(roads, rect, half_m), Looks(roads, rect, VIEW_M, SEE_M, half_m)
    same_looks(found, twin)
    assert np.isfinite(found["line"]).any() == (name == "grid4x4")
    # On grid4x4, only long vehicles and steered cars sweep over adjacent paths; on merge, none do.
    sweeps = name == "grid4x4" and (half_m == HALF_M or steered)
    assert np.isfinite(found["room"]).any() == sweeps


@pytest.mark.parametrize("side_m", [60.0, 140.0])
@pytest.mark.parametrize("part", [(0.0, 0.0, 0.2, 0.2), (0.45, 0.45, 0.55, 0.55)])
def test_merging_drivers_see_vehicles_before_the_previous_junction(
    tmp_path: Path, side_m: float, part: tuple[float, float, float, float]
) -> None:
    """A merge point can be beyond the end of a lane if no vehicle has to stop at that end."""
    options = ("--grid.number", "7", "--grid.length", str(side_m), "-L", "2")
    net = netgenerate(tmp_path / "net.net.xml", "-g", "-j", "priority_stop", *options)
    roads = read_network(net)
    min_x, min_y, max_x, max_y = roads.extent_m
    low, high = np.array([min_x, min_y] * 2), np.array([max_x, max_y] * 2)
    rect = tuple((low + np.array(part) * (high - low)).tolist())
    found, twin = looks_of(roads, rect), Looks(roads, rect, VIEW_M, SEE_M, HALF_M)
    same_looks(found, twin)
    length_m = roads.lanes["length_m"]
    over = np.isfinite(found["merge"]) & (found["merge"] > length_m + ROUNDING_M)
    assert over.any()
    assert (found["merge"][over] - length_m[over] < MERGES_M).all()


@pytest.mark.parametrize(("junctions", "seen"), [("right_before_left", 4), ("priority", 1)])
def test_drivers_on_equal_roads_see_the_vehicles_to_which_their_foe_yields(
    tmp_path: Path, junctions: str, seen: int
) -> None:
    """On roads without priority, a driver looks for deadlocks.

    It looks at the vehicle on a conflicting path (the foe), and at the vehicles to which that
    vehicle yields.
    """
    roads = read_network(netgenerate(tmp_path / "net.net.xml", "-g", "-j", junctions))
    links, conflicts = roads.links.copy(), roads.conflicts.copy()
    middle = np.bincount(links["junction"]).argmax()
    one, other, *rest = ends = np.unique(links["from_lane"][links["junction"] == middle])
    assert len(rest) == 2
    # All conflicts of the links from `one` now have the same foe: the link from `other` that must
    # yield to the most links.
    owner = np.repeat(np.arange(len(links)), links["num_conflicts"])
    yields = np.bincount(owner[conflicts["must_yield"]], minlength=len(links))
    conflicts["foe"][links["from_lane"][owner] == one] = np.argmax(
        np.where(links["from_lane"] == other, yields, -1)
    )
    links["num_sweeps"] = 0
    roads = replace(roads, links=links, conflicts=conflicts)
    lane = roads.lanes[one]
    x, y, *_ = roads.points[lane["first_point"] + lane["num_points"] - 1].tolist()
    rect = (x - 0.5, y - 0.5, x + 0.5, y + 0.5)
    found, twin = looks_of(roads, rect), Looks(roads, rect, VIEW_M, SEE_M, HALF_M)
    expected = np.array([twin.line[k] for k in range(len(roads.lanes))])
    np.testing.assert_allclose(found["line"], expected, atol=2.0 * STEP_M)
    assert np.isfinite(found["line"][ends]).sum() == seen


@pytest.mark.parametrize("from_line_m", [-40.0, 10.0, 95.0, 120.0])
def test_vehicles_past_a_shorter_lane_are_seen_from_the_longer_lane(
    tmp_path: Path, from_line_m: float
) -> None:
    """Two lanes of a road end at different places before the same junction.

    `from_line_m`: distance of the zone before the stop line. At -40, the zone is beyond the
    junction; at 120, it is too far away.
    """
    path = build_crossing(tmp_path, "priority", side_lanes=2)
    roads = read_network(with_shorter_lane(path, "S_in_1", 8.0))
    turn = roads.lane_ids.index(":c_10_0")
    y = float(roads.lanes["length_m"][roads.lane_ids.index("S_in_0")]) - from_line_m
    rect = (140.0, y - 10.0, 160.0, y - 9.0)
    found, twin = looks_of(roads, rect), Looks(roads, rect, VIEW_M, SEE_M, HALF_M)
    for field, told in (("head", twin.head), ("back", twin.back), ("tail", twin.tail)):
        expected = np.array([told[lane] for lane in range(len(found))])
        np.testing.assert_allclose(found[field], expected, atol=2.0 * STEP_M, err_msg=field)
    assert (found["head"][turn] > 8.0 + HALF_M) == (from_line_m < 120.0)
    assert (found["back"][turn] < np.inf) == (from_line_m < 0.0)


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    path = tmp_path_factory.mktemp("line") / "line.net.xml"
    edges = [EDGE.format(n=n, end=n + 1, start=400 * n, stop=400 * n + 400) for n in range(3)]
    path.write_text(LINE.format(edges="\n  ".join(edges)), encoding="utf-8")
    return load_network(path)


def test_drivers_look_farther_ahead_than_back(line: RoadNetwork) -> None:
    """The zone is at the end of the second road; its drivers also look at the third road."""
    before, own, beyond = looks_of(line, (780.0, -10.0, 795.0, 10.0))
    assert before["head"] == -np.inf
    assert before["back"] == np.inf, "distant followers are seen"
    assert own["tail"] == pytest.approx(380.0 - ASIDE_M - VIEW_M - ROUNDING_M)
    assert beyond["head"] == pytest.approx(VIEW_M + ROUNDING_M)
    assert (np.array([before["line"], own["line"], beyond["line"]]) == np.inf).all()


def test_a_follower_across_a_border_is_seen(line: RoadNetwork) -> None:
    """The zone begins 50 m after the end of the first road; a follower may be on that road."""
    before, own, beyond = looks_of(line, (450.0, -10.0, 460.0, 10.0))
    assert before["tail"] == np.inf
    assert before["back"] == pytest.approx(400.0 + 50.0 - ASIDE_M - ROUNDING_M)
    assert own["head"] == pytest.approx(60.0 + ASIDE_M + VIEW_M + ROUNDING_M)
    assert beyond["head"] == -np.inf


def test_a_zone_without_roads_sees_no_vehicles(line: RoadNetwork) -> None:
    looks = looks_of(line, (0.0, 50.0, 1200.0, 90.0))
    assert (looks["head"] == -np.inf).all()
    assert (looks["tail"] == np.inf).all()
    assert (looks["back"] == np.inf).all()


@pytest.mark.parametrize("part", [(0.0, 0.0, 0.4, 1.0), (0.5, 0.5, 0.6, 0.6)])
def test_farthest_m_is_the_distance_of_the_farthest_visible_vehicle(
    part: tuple[float, float, float, float],
) -> None:
    """The expected distance comes from closely spaced positions on all lanes."""
    roads = network("grid4x4")
    min_x, min_y, max_x, max_y = roads.extent_m
    low, high = np.array([min_x, min_y] * 2), np.array([max_x, max_y] * 2)
    rect = low + np.array(part) * (high - low)
    looks = looks_of(roads, tuple(rect.tolist()))
    farthest = 0.0
    for lane, look in zip(roads.lanes, looks, strict=True):
        points = roads.points[lane["first_point"] :][: lane["num_points"]]
        s = np.arange(0.0, points["s"][-1], STEP_M)
        x, y = (np.interp(s, points["s"], points[axis]) for axis in ("x", "y"))
        asked = (s <= look["head"]) | (s >= look["tail"])
        asked |= min(look["back"], look["line"]) - s < APPROACH_M
        asked |= look["merge"] - s < MERGES_M
        dx = np.maximum(np.maximum(rect[0] - x, x - rect[2]), 0.0)
        dy = np.maximum(np.maximum(rect[1] - y, y - rect[3]), 0.0)
        farthest = max(farthest, float(np.hypot(dx, dy)[asked].max(initial=0.0)))
    found = farthest_m(roads.arrays, rect[None, :], 0, looks)
    assert 0.0 <= found - farthest <= 2.0 * STEP_M
    assert VIEW_M < found


def test_farthest_m_is_zero_without_visible_vehicles(line: RoadNetwork) -> None:
    rect = (0.0, 50.0, 1200.0, 90.0)
    assert farthest_m(line.arrays, np.array([rect]), 0, looks_of(line, rect)) == 0.0
