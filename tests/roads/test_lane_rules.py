"""Rules of lanes in SUMO's networks: solid lines, stop offsets, and ignored rules."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import MapError
from cavmarl.core.records.codes import NO_CHANGE_LEFT, NO_CHANGE_RIGHT
from cavmarl.maps.check import check_map
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.routing import make_plans
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.demand_worlds import make
from tests.support.driving import drive, start
from tests.support.mirrored import mirror_net
from tests.support.netgenerate import netgenerate

BUS = 1 << VEHICLE_CLASSES.index("bus")
GRID = ["--grid", "--grid.number", "3", "--grid.length", "150", "-L", "2"]
ROAD = "B0B1"


@pytest.fixture
def grid(tmp_path: Path) -> Path:
    return netgenerate(tmp_path / "grid.net.xml", *GRID)


def with_rules(source: Path, rules: str, inside: str = "", lane: str = f"{ROAD}_0") -> Path:
    """Write a network in which one lane has added attributes and elements."""
    text = source.read_text()
    begin = text.index(f'<lane id="{lane}"')
    end = text.index("/>", begin)
    text = f"{text[:end]} {rules}>{inside}</lane>{text[end + 2 :]}"
    target = source.with_name("rules.net.xml")
    target.write_text(text)
    return target


def classes_without_change(network: RoadNetwork, lane: str, side: int) -> int:
    bits = int(network.lanes["permissions"][network.lane_ids.index(lane)])
    return (bits >> (NO_CHANGE_LEFT if side > 0 else NO_CHANGE_RIGHT)) & 0x1FF


def test_lanes_forbid_lane_changes_to_vehicle_classes(grid: Path) -> None:
    rules = with_rules(grid, 'changeLeft="bus"')
    network = read_network(rules)
    assert classes_without_change(network, f"{ROAD}_0", 1) == 0x1FF & ~BUS
    assert (
        classes_without_change(network, f"{ROAD}_0", -1)
        == classes_without_change(network, f"{ROAD}_1", 1)
        == 0
    )
    mirrored = read_network(mirror_net(rules, rules.with_name("left.net.xml")))
    # In left-hand traffic, SUMO's "left" is to the right.
    assert classes_without_change(mirrored, f"{ROAD}_0", -1) == 0x1FF & ~BUS


@pytest.mark.parametrize("rules", ["", 'changeLeft="all" changeRight=""'])
def test_networks_without_rules_are_unchanged(grid: Path, rules: str) -> None:
    assert read_network(with_rules(grid, rules)).content_hash == read_network(grid).content_hash


def test_plans_have_no_lane_change_across_a_solid_line(grid: Path) -> None:
    plain = read_network(grid)
    lane = plain.lane_ids.index(f"{ROAD}_0")
    goals = [
        {
            int(plain.lanes["edge"][to])
            for to in plain.links["to_lane"][plain.links["from_lane"] == row]
        }
        for row in (lane, lane + 1)
    ]
    goal = plain.edge_ids.index("B1A1")
    assert [goal in found for found in goals] == [False, True]
    assert make_plans(plain, [goal])[0, lane]["change"] == 1
    network = read_network(with_rules(grid, 'changeLeft="bus"'))
    assert make_plans(network, [goal])[0, lane]["change"] == 0
    assert make_plans(network, [goal], "bus")[0, lane]["change"] == 1


def test_stop_offsets_move_stop_lines(grid: Path) -> None:
    offset = '<stopOffset value="4.5" exceptions="bicycle"/>'
    network = read_network(with_rules(grid, "", offset))
    plain = read_network(grid)
    moved = network.lanes["stop_back_m"] != plain.lanes["stop_back_m"]
    assert [network.lane_ids[row] for row in np.flatnonzero(moved)] == [f"{ROAD}_0"]
    assert network.lanes["stop_back_m"][moved].tolist() == [4.5]
    assert network.notes == ()


def test_rules_that_are_not_simulated_are_counted(grid: Path) -> None:
    inside = '<neigh lane="B1B0_1"/><stopOffset value="3" vClasses="truck"/>'
    notes = (
        "1 <neigh> elements (overtaking on the opposite lane) ignored",
        "1 stop offsets that do not hold for passenger cars ignored",
    )
    path = with_rules(grid, "", inside)
    assert read_network(path).notes == notes
    assert check_map(path).notes[:2] == notes


@pytest.mark.parametrize("value", ['value="x"', "", 'value="nan"'])
def test_bad_stop_offsets_are_refused(grid: Path, value: str) -> None:
    with pytest.raises(MapError, match="<stopOffset> has "):
        read_network(with_rules(grid, "", f"<stopOffset {value}/>"))


LORRY = """<routes>
  <vType id="slow" maxSpeed="4" length="7" sigma="0"/><vType id="fast" sigma="0"/>
  <vehicle id="s" type="slow" depart="0" departLane="0"><route edges="B0B1 B1B2"/></vehicle>
  <vehicle id="f" type="fast" depart="5" departLane="0"><route edges="B0B1 B1B2"/></vehicle>
</routes>"""


@pytest.mark.parametrize(("rules", "lanes"), [("", {0, 1}), ('changeLeft="bus"', {0})])
def test_drivers_do_not_overtake_across_a_solid_line(
    grid: Path, tmp_path: Path, rules: str, lanes: set[int]
) -> None:
    demand = tmp_path / "lorry.rou.xml"
    demand.write_text(LORRY)
    world = make(with_rules(grid, rules), [demand])
    start(world, 0)
    road = world.network.edge_ids.index(ROAD)
    seen = set()
    for _ in range(600):
        drive(world)
        places = world.network.lanes[world.vehicles(0)["lane"]]
        seen |= set(places["index"][places["edge"] == road].tolist())
    assert seen == lanes
