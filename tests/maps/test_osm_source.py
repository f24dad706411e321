"""OSM tags of lanes and access are applied to the lanes of the network."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.maps.netconvert import BuildResult, build_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.map_sources import osm_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

NODES = {1: (0.0, 0.0), 2: (0.0, 200.0), 3: (0.0, -200.0), 4: (150.0, 0.0), 5: (-150.0, 0.0)}
THREE = {"highway": "primary", "lanes": "3", "oneway": "yes"}
TURNS = THREE | {"turn:lanes": "left|through|right"}
ACROSS = {12: ([5, 1, 4], {"highway": "primary"})}


def built(
    tmp_path: Path, ways: dict[int, tuple[list[int], dict[str, str]]], more: str = ""
) -> tuple[RoadNetwork, BuildResult]:
    path = tmp_path / "map.osm"
    text = osm_file((NODES, ACROSS | ways), 48.1, 11.5)
    path.write_text(text.replace("</osm>", f"{more}</osm>"))
    result = build_network(path, tmp_path / "map.net.xml")
    return read_network(result.path), result


def turns(network: RoadNetwork) -> dict[int, str]:
    """Return the directions in which each lane of the road from the north leads, by lane index."""
    found: dict[int, str] = {}
    for row in network.links:
        lane = network.lanes[row["from_lane"]]
        first, *_, last = network.lane_polyline(row["from_lane"])
        if first[1] - last[1] > 100.0 and row["direction"] != ord("t"):
            found[int(lane["index"])] = found.get(int(lane["index"]), "") + chr(row["direction"])
    return found


@pytest.mark.parametrize(
    ("ways", "notes"),
    [
        ({11: ([2, 1, 3], TURNS)}, ("1 ways with turn:lanes are cut at a junction",)),
        ({11: ([2, 1], TURNS), 13: ([1, 3], THREE)}, ()),
    ],
)
def test_turn_lanes_lead_in_their_tagged_directions(
    tmp_path: Path, ways: dict[int, tuple[list[int], dict[str, str]]], notes: tuple[str, ...]
) -> None:
    network, result = built(tmp_path, ways)
    assert turns(network) == {0: "r", 1: "s", 2: "l"}
    assert result.notes == notes


def test_turn_lanes_of_both_directions_lead_in_their_tagged_directions(tmp_path: Path) -> None:
    tags = {
        "highway": "primary",
        "lanes": "4",
        "turn:lanes:forward": "left|through;right",
        "turn:lanes:backward": "left;through|right",
    }
    network, _ = built(tmp_path, {11: ([2, 1, 3], tags)})
    assert turns(network) == {0: "rs", 1: "l"}
    back = {
        (int(network.lanes["index"][row["from_lane"]]), chr(row["direction"]))
        for row in network.links
        if network.lane_polyline(row["from_lane"])[0, 1] < 50.0
        and network.lane_polyline(row["from_lane"])[-1, 1]
        - network.lane_polyline(row["from_lane"])[0, 1] > 100.0
        and row["direction"] != ord("t")
    }  # fmt: skip
    assert back == {(0, "r"), (1, "s"), (1, "l")}


@pytest.mark.parametrize(("start", "end"), [(11, 14), (12, 11)])
def test_turn_restrictions_are_kept_on_ways_that_are_cut(
    tmp_path: Path, start: int, end: int
) -> None:
    relation = (
        f'<relation id="7"><member type="way" ref="{start}" role="from"/>'
        f'<member type="node" ref="1" role="via"/><member type="way" ref="{end}" role="to"/>'
        '<tag k="type" v="restriction"/><tag k="restriction" v="no_right_turn"/></relation>'
    )
    parts = {name: (nodes, {"highway": "primary"}) for name, nodes in ((12, [5, 1]), (14, [1, 4]))}
    _, result = built(tmp_path, {11: ([2, 1, 3], TURNS)} | parts, relation)
    assert not [text for text in result.warnings if "restriction" in text]


def test_bus_lanes_are_closed_to_cars(tmp_path: Path) -> None:
    network, _ = built(
        tmp_path, {11: ([2, 1, 3], THREE | {"bus:lanes": "yes|yes|designated",
                                            "vehicle:lanes": "yes|yes|no"})}
    )  # fmt: skip
    roads = dict(zip(network.lane_ids, network.lanes, strict=True))
    assert [bool(roads[f"11#0_{n}"]["permissions"] & 1) for n in range(3)] == [False, True, True]
    network, _ = built(
        tmp_path, {11: ([2, 1, 3], {"highway": "primary", "lanes": "4", "busway": "lane"})}
    )
    roads = dict(zip(network.lane_ids, network.lanes, strict=True))
    assert [bool(roads[f"{way}11#0_0"]["permissions"] & 1) for way in ("", "-")] == [False, False]
    assert [bool(roads[f"{way}11#0_1"]["permissions"] & 1) for way in ("", "-")] == [True, True]


@pytest.mark.parametrize(
    ("tags", "closed"),
    [
        ({"motor_vehicle": "no"}, True),
        ({"vehicle": "no", "bus": "yes"}, True),
        ({"motorcar": "no"}, True),
        ({"motor_vehicle": "no", "motorcar": "yes"}, False),
        ({"motor_vehicle": "destination"}, False),
    ],
)
def test_ways_closed_to_motor_vehicles_are_left_out(
    tmp_path: Path, tags: dict[str, str], closed: bool
) -> None:
    ways = {11: ([2, 1], {"highway": "primary"}), 13: ([1, 3], {"highway": "primary"} | tags)}
    network, result = built(tmp_path, ways)
    assert ("13" not in network.edge_ids) == closed
    note = "1 ways are closed to motor vehicles and left out"
    assert result.notes == ((note,) if closed else ())


def test_tags_that_are_ignored_are_counted(tmp_path: Path) -> None:
    _, result = built(tmp_path, {11: ([2, 1, 3], THREE | {"lanes:psv": "1"})})
    assert result.notes == ("1 ways have lanes:psv, which is ignored",)
