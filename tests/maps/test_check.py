from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sumolib.net
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.config.registry import load_config
from cavmarl.engine.world_setup import load_roads
from cavmarl.maps.check import MapReport, check_map
from cavmarl.maps.components import strong_components
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.kept_maps import network_of

BuiltMap = Callable[[str], Path]

# Road km, lane km, junctions, signals, edges in the largest connected part, all edges. Two of the
# 37 junctions of Mcity join only footpaths and are not counted.
FIGURES = {
    "osm/monaco.osm.gz": (76.81, 96.54, 265, 4, 591, 636),
    "osm/laufamholz.osm.xml": (6.96, 8.23, 15, 2, 51, 51),
    "osm/berlin_siegessaeule.osm.gz": (5.93, 17.70, 8, 1, 8, 31),
    "net/bologna_acosta/acosta_buslanes.net.xml": (19.88, 30.91, 60, 7, 115, 164),
    "net/mcity/mcity.net.xml": (2.58, 3.42, 35, 6, 85, 91),
    "net/Town10HD.net.xml": (1.65, 3.11, 18, 5, 46, 46),
    "xodr/Town10HD.xodr": (1.64, 3.10, 18, 5, 46, 46),
    "xodr/Town01.xodr": (4.96, 4.96, 20, 16, 52, 52),
    "xodr/Town04.xodr": (9.24, 25.01, 33, 12, 99, 99),
    "xodr/multi_intersections.xodr": (5.36, 5.45, 19, 20, 46, 46),
    "xodr/fabriksgatan.xodr": (1.06, 1.06, 1, 0, 8, 8),
    "xodr/newmarket.xodr": (26.65, 26.65, 59, 0, 196, 196),
    "xodr/soderleden_invalid.xodr": (1.86, 3.65, 1, 0, 1, 7),
}

# A ring of two one-way roads, and a spur, which is a dead end.
RING = """<net version="1.20">
  <edge id="a" from="A" to="B">
    <lane id="a_0" index="0" speed="10" length="50" shape="0,0 50,0"/>
  </edge>
  <edge id="b" from="B" to="A">
    <lane id="b_0" index="0" speed="10" length="50" shape="50,3 0,3"/>
  </edge>
  <edge id="x" from="B" to="C">
    <lane id="x_0" index="0" speed="10" length="50" shape="50,0 99,0"/>
  </edge>
  <junction id="A" type="priority" x="0" y="0" incLanes="b_0" intLanes="" shape=""/>
  <junction id="B" type="priority" x="50" y="0" incLanes="a_0" intLanes="" shape=""/>
  <junction id="C" type="dead_end" x="99" y="0" incLanes="x_0" intLanes="" shape=""/>
  <connection from="a" to="b" fromLane="0" toLane="0" dir="t" state="M"/>
  <connection from="b" to="a" fromLane="0" toLane="0" dir="t" state="M"/>
  <connection from="a" to="x" fromLane="0" toLane="0" dir="s" state="M"/>
</net>
"""


# Two roads that a signal joins; the tests insert its phases.
SIGNALLED = """<net version="1.20">
  <edge id="a" from="A" to="B">
    <lane id="a_0" index="0" speed="10" length="50" shape="0,0 50,0"/>
  </edge>
  <edge id="b" from="B" to="A">
    <lane id="b_0" index="0" speed="10" length="50" shape="50,3 0,3"/>
  </edge>
  <tlLogic id="T" type="static" programID="0" offset="0">{phases}</tlLogic>
  <junction id="A" type="priority" x="0" y="0" incLanes="b_0" intLanes="" shape=""/>
  <junction id="B" type="traffic_light" x="50" y="0" incLanes="a_0" intLanes="" shape=""/>
  <connection from="a" to="b" fromLane="0" toLane="0" dir="t" state="o" tl="T" linkIndex="0"/>
  <connection from="b" to="a" fromLane="0" toLane="0" dir="t" state="M"/>
</net>
"""


@pytest.mark.parametrize(
    ("phases", "is_held"),
    [
        ([(1000, "r"), (10, "G")], True),
        ([(10, "G"), (99999, "r")], True),
        ([(999, "r"), (10, "G")], False),
        ([(99999, "G"), (10, "r")], False),
        ([(99999, "O")], False),
    ],
)
def test_signals_with_a_long_red_phase_are_reported(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    phases: list[tuple[int, str]],
    is_held: bool,
) -> None:
    lines = [f'<phase duration="{seconds}" state="{state}"/>' for seconds, state in phases]
    path = tmp_path / "map.net.xml"
    path.write_text(SIGNALLED.format(phases="".join(lines)))
    report = check_map(path)
    words = "1 signal holds a phase with red for 1,000 s or more, so that vehicles wait: T"
    assert report.signals_held == (("T",) if is_held else ())
    assert any(words in note for note in report.notes) == is_held
    caplog.clear()
    load_roads(*load_config(path))
    assert (words in caplog.text) == is_held


@pytest.fixture
def check(tmp_path: Path) -> Callable[..., MapReport]:
    def check_ring(*changes: tuple[str, str]) -> MapReport:
        text = RING
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "ring.net.xml"
        path.write_text(text)
        return check_map(read_network(path))

    return check_ring


@pytest.mark.parametrize("name", FIGURES)
def test_figures_of_real_maps_equal_known_values(built_map: BuiltMap, name: str) -> None:
    report = check_map(network_of(built_map(name)))
    road_km, lane_km, junctions, signals, connected, edges = FIGURES[name]
    assert report.drivable
    assert round(report.road_km, 2) == road_km
    assert round(report.lane_km, 2) == lane_km
    assert (report.junctions, report.signals) == (junctions, signals)
    assert (report.connected_edges, report.edges) == (connected, edges)


@pytest.mark.parametrize("name", FIGURES)
def test_figures_of_real_maps_equal_those_of_sumolib(built_map: BuiltMap, name: str) -> None:
    path = built_map(name)
    report = check_map(network_of(path))
    net = sumolib.net.readNet(str(path), withPrograms=True, withInternal=True)
    edges = [edge for edge in net.getEdges(withInternal=False) if edge.allows("passenger")]
    lanes = [lane for edge in edges for lane in edge.getLanes() if lane.allows("passenger")]
    assert report.edges == len(edges)
    assert report.lanes == len(lanes)
    assert report.road_km == pytest.approx(sum(edge.getLength() for edge in edges) / 1e3)
    assert report.lane_km == pytest.approx(sum(lane.getLength() for lane in lanes) / 1e3)
    assert report.signals == len(net.getTrafficLights())
    types = Counter(node.getType() for node in net.getNodes())
    assert report.junctions_by_type == dict(types)
    ends = {edge.getID() for edge in edges if not edge.getAllowedOutgoing("passenger")}
    assert set(report.dead_ends) == ends


def test_a_poorly_connected_map_is_drivable_and_reported(built_map: BuiltMap) -> None:
    report = check_map(network_of(built_map("osm/berlin_siegessaeule.osm.gz")))
    assert report.drivable
    assert any("only 26% of the edges" in note for note in report.notes)


def test_steep_lanes_are_reported(built_map: BuiltMap) -> None:
    report = check_map(network_of(built_map("net/mcity/mcity.net.xml")))
    assert report.elevation_m == pytest.approx((266.0, 279.4), abs=0.05)
    assert report.max_grade == pytest.approx(0.346, abs=0.001)
    assert any("climbs 35%" in note for note in report.notes)


def test_the_report_of_a_ring_with_a_spur_names_its_dead_end(
    check: Callable[..., MapReport],
) -> None:
    report = check()
    assert report.drivable
    assert (report.connected_edges, report.edges) == (2, 3)
    assert report.dead_ends == ("x",)
    assert report.junctions == 1
    assert report.junctions_by_type == {"priority": 2, "dead_end": 1}
    assert report.extent_m == (0.0, 0.0, 99.0, 3.0)
    assert report.lanes_without_successor == report.self_loops == report.speed_outliers == ()
    assert json.loads(json.dumps(report.to_dict()))["drivable"] is True


def test_a_map_without_connections_cannot_be_driven(check: Callable[..., MapReport]) -> None:
    report = check(("<connection ", "<param key='' value='' "))
    assert not report.drivable
    assert report.problems == (
        "no edge leads to another edge: the map has no connections: build it again",
    )


def test_a_map_that_is_open_to_buses_only_cannot_be_driven(check: Callable[..., MapReport]) -> None:
    report = check(("<lane ", '<lane allow="bus" '))
    assert not report.drivable
    assert (report.edges, report.road_km, report.connected_share) == (0, 0.0, 0.0)
    assert "no edge is open to passenger cars" in report.problems[0]


def test_unusual_lanes_and_edges_are_named(check: Callable[..., MapReport]) -> None:
    second = '<lane id="a_1" index="1" speed="500" length="50" shape="0,3 50,3"/>'
    report = check(
        ('</edge>\n  <edge id="b"', f'{second}</edge>\n  <edge id="b"'),
        ('id="x" from="B" to="C"', 'id="x" from="B" to="B"'),
        ('incLanes="x_0"', 'incLanes=""'),
        ('id="x_0" index="0" speed="10"', 'id="x_0" index="0" speed="0.5"'),
    )
    assert report.lanes_without_successor == ("a_1",)
    assert report.self_loops == ("x",)
    assert report.speed_outliers == ("a_1", "x_0")
    assert len(report.notes) == 6  # one of the notes says that the lanes a_1 and b_0 overlap


def test_a_junction_without_right_of_way_is_named(check: Callable[..., MapReport]) -> None:
    back = '<connection from="x" to="b" fromLane="0" toLane="0" dir="t" state="M"/>\n</net>'
    unruled = (
        ("</net>", back),
        ('id="x" from="B" to="C"', 'id="x" from="C" to="B"'),
        ('incLanes="x_0"', 'incLanes=""'),
        ('incLanes="a_0"', 'incLanes="a_0 x_0"'),
        ('  <connection from="a" to="x" fromLane="0" toLane="0" dir="s" state="M"/>\n', ""),
    )
    report = check(*unruled)
    assert report.junctions_without_right_of_way == ("B",)
    requests = (
        '<request index="0" response="00" foes="10"/><request index="1" response="01" foes="01"/>'
    )
    shape = 'incLanes="a_0 x_0" intLanes="" shape=""'
    report = check(*unruled, (f"{shape}/>", f"{shape}>{requests}</junction>"))
    assert report.junctions_without_right_of_way == ()


def test_signals_that_are_never_green_or_control_no_lane_are_named(
    check: Callable[..., MapReport],
) -> None:
    programs = "".join(
        f'<tlLogic id="{name}" type="static" programID="0" offset="0">'
        f'<phase duration="30" state="{state}"/></tlLogic>'
        for name, state in (("idle", "G"), ("shut", "ry"))
    )
    report = check(
        ('  <junction id="A"', f'{programs}<junction id="A"'),
        ('dir="s" state="M"', 'dir="s" state="o" tl="shut" linkIndex="1"'),
    )
    assert report.signals == 2
    assert report.signals_without_lanes == ("idle",)
    assert report.lanes_never_green == ("a_0",)


@given(
    st.integers(1, 12).flatmap(
        lambda size: st.tuples(
            st.just(size), st.lists(st.tuples(*[st.integers(0, size - 1)] * 2), max_size=30)
        )
    )
)
def test_nodes_are_in_one_component_if_each_reaches_the_other(
    graph: tuple[int, list[tuple[int, int]]],
) -> None:
    size, arcs = graph
    component = strong_components(size, np.array(arcs, np.int32).reshape(-1, 2))
    reach = np.eye(size, dtype=bool)
    for source, target in arcs:
        reach[source, target] = True
    for middle in range(size):
        reach |= reach[:, middle, None] & reach[middle]
    assert ((component[:, None] == component) == (reach & reach.T)).all()
    assert set(component) == set(range(component.max() + 1))


def test_components_of_a_road_of_100000_edges_are_found() -> None:
    road = np.stack([np.arange(99_999), np.arange(1, 100_000)], axis=1).astype(np.int32)
    assert len(np.unique(strong_components(100_000, road))) == 100_000
