"""Properties that every road network must have, checked on real maps, and against sumolib."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sumolib.net

from cavmarl.core.errors import MapError
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.kept_maps import network_of

BuiltMap = Callable[[str], Path]

MAPS = [
    "net/Town10HD.net.xml", "net/bologna_acosta/acosta_buslanes.net.xml", "net/mcity/mcity.net.xml",
    "osm/berlin_siegessaeule.osm.gz", "osm/laufamholz.osm.xml", "osm/monaco.osm.gz",
    "xodr/Town01.xodr", "xodr/Town04.xodr", "xodr/Town10HD.xodr", "xodr/fabriksgatan.xodr",
    "xodr/multi_intersections.xodr", "xodr/newmarket.xodr", "xodr/soderleden_invalid.xodr",
]  # fmt: skip

# Networks in SUMO's package. They have pedestrians, trams, bicycles, trains, motorways and
# zipper merges.
GAMES = [
    "A10KW/osm.net.xml", "DRT/osm.net.xml", "bs3d/bs.net.xml", "cross/cross.net.xml",
    "fkk_in/ingolstadt.net.xml.gz", "fokr_bs_demo/fokr_bs.net.xml.gz", "grid6/grid6.net.xml",
    "highway/highway.net.xml", "hiking/hiking.net.xml", "ramp/ramp.net.xml",
]  # fmt: skip
NOT_FOR_CARS = ["rail/net.net.xml", "rail_demo/net.net.xml", "racing/spreewaldring.net.xml"]


def network_of_sumo(name: str) -> Path:
    sumo = pytest.importorskip("sumo")
    path = Path(sumo.SUMO_HOME) / "tools" / "network_of_sumo" / name
    if not path.exists():
        pytest.skip(f"this version of SUMO has no {name}")
    return path


def check_points(network: RoadNetwork) -> None:
    points, lanes = network.points, network.lanes
    assert (lanes["num_points"] >= 2).all()
    assert lanes["first_point"].tolist() == [0, *np.cumsum(lanes["num_points"])[:-1]]
    last = lanes["first_point"] + lanes["num_points"] - 1
    assert (points["s"][lanes["first_point"]] == 0.0).all()
    assert (points["s"][last] == lanes["length_m"]).all()
    inner = np.setdiff1d(np.arange(len(points)), last)
    step = points["s"][inner + 1] - points["s"][inner]
    assert (step > 0.0).all()
    for axis, direction in (("x", "cos"), ("y", "sin"), ("z", "slope")):
        end = points[axis][inner] + step * points[direction][inner]
        np.testing.assert_allclose(end, points[axis][inner + 1], atol=1e-6)
    np.testing.assert_allclose(np.hypot(points["cos"], points["sin"]), 1.0)
    for name in points.dtype.names:
        assert np.isfinite(points[name]).all()


def check_lanes(network: RoadNetwork) -> None:
    lanes, edges = network.lanes, network.edges
    rows = np.arange(len(lanes))
    assert edges["first_lane"].tolist() == [0, *np.cumsum(edges["num_lanes"])[:-1]]
    assert (rows == edges["first_lane"][lanes["edge"]] + lanes["index"]).all()
    has_left, has_right = lanes["left"] >= 0, lanes["right"] >= 0
    assert (lanes["right"][lanes["left"][has_left]] == rows[has_left]).all()
    assert (lanes["left"][lanes["right"][has_right]] == rows[has_right]).all()
    assert (lanes["edge"][lanes["left"][has_left]] == lanes["edge"][has_left]).all()
    assert (lanes["speed_mps"] > 0.0).all()
    assert (lanes["permissions"] > 0).all()
    lanes_of_link = np.bincount(lanes["link"][lanes["internal"]], minlength=1)
    inside = lanes["internal"] & (has_left | has_right)
    assert (lanes_of_link[lanes["link"][inside]] == 1).all()
    internal = edges["internal"]
    assert (edges["from_junction"][internal] == edges["to_junction"][internal]).all()


def check_links(network: RoadNetwork) -> None:
    lanes, links = network.lanes, network.links
    assert (np.diff(links["from_lane"]) >= 0).all()
    assert not lanes["internal"][links["from_lane"]].any()
    assert not lanes["internal"][links["to_lane"]].any()
    assert lanes["num_links"].sum() == len(links)
    leads_to: dict[int, set[int]] = {}
    on_a_link = np.zeros(len(lanes), bool)
    for number, link in enumerate(links):
        source, length = int(link["from_lane"]), 0.0
        first = lanes["first_link"][source]
        assert first <= number < first + lanes["num_links"][source]
        assert lanes["edge"][source] in np.flatnonzero(
            network.edges["to_junction"] == link["junction"]
        )
        lane = int(link["next_lane"])
        while lanes["internal"][lane]:
            leads_to.setdefault(lane, set()).add(source)
            assert lanes["link"][lane] == number
            assert lanes["link_offset_m"][lane] == pytest.approx(length)
            on_a_link[lane] = True
            length += lanes["length_m"][lane]
            source, lane = lane, int(lanes["successor"][lane])
        leads_to.setdefault(lane, set()).add(source)
        assert lane == link["to_lane"]
        assert link["length_m"] == pytest.approx(length)
    assert (on_a_link == lanes["internal"]).all()
    for row, lane in enumerate(lanes):
        into = network.into[lane["first_into"] : lane["first_into"] + lane["num_into"]]
        assert set(into.tolist()) == leads_to.get(row, set())


def check_conflicts(network: RoadNetwork) -> None:
    links, conflicts = network.links, network.conflicts
    owner = np.repeat(np.arange(len(links)), links["num_conflicts"])
    rows = {
        (int(a), int(b)): row for a, b, row in zip(owner, conflicts["foe"], conflicts, strict=True)
    }
    assert len(rows) == len(conflicts)
    assert list(rows) == sorted(rows)
    for (mine, foe), row in rows.items():
        reverse = rows[foe, mine]
        assert 0.0 <= row["enter_m"] <= row["leave_m"] <= links["length_m"][mine] + 1e-9
        assert (row["foe_enter_m"], row["foe_leave_m"]) == (reverse["enter_m"], reverse["leave_m"])
        assert links["junction"][mine] == links["junction"][foe]
        if links["to_lane"][mine] == links["to_lane"][foe]:
            assert row["leave_m"] == pytest.approx(links["length_m"][mine])


def check_signals(network: RoadNetwork) -> None:
    signals, phases = network.signals, network.phases
    ruled = network.links[network.links["signal"] >= 0]
    assert (ruled["signal_index"] < signals["num_links"][ruled["signal"]]).all()
    for signal in signals:
        program = network.programs[signal["program"]]
        mine = phases[program["first_phase"] : program["first_phase"] + program["num_phases"]]
        assert mine["duration_s"].sum() == program["cycle_s"] > 0.0
        assert (np.diff(mine["first_state"]) == signal["num_links"]).all()


def check_against_sumolib(network: RoadNetwork, net: Any) -> None:
    links, conflicts = network.links, network.conflicts
    connections = []
    for link in links:
        source = net.getLane(network.lane_ids[link["from_lane"]])
        target = net.getLane(network.lane_ids[link["to_lane"]])
        (found,) = [c for c in source.getOutgoing() if c.getToLane() == target]
        assert found.getJunctionIndex() == link["index"]
        assert found.getJunction().getID() == network.junction_ids[link["junction"]]
        assert found.getDirection() == chr(link["direction"])
        assert found.getState() == chr(link["state"])
        light = network.signal_ids[link["signal"]] if link["signal"] >= 0 else ""
        if found.getJunction().getType() not in ("rail_signal", "rail_crossing"):
            assert (found.getTLSID(), found.getTLLinkIndex()) == (light, link["signal_index"])
        connections.append(found)
    for mine, link in enumerate(links):
        rows = slice(link["first_conflict"], link["first_conflict"] + link["num_conflicts"])
        listed = dict(zip(conflicts["foe"][rows], conflicts["must_yield"][rows], strict=True))
        node = connections[mine].getJunction()
        for foe in np.flatnonzero(links["junction"] == link["junction"]) if node._foes else ():
            a, b = int(link["index"]), int(links["index"][foe])
            either = foe != mine and (node.areFoes(a, b) or node.areFoes(b, a))
            # The list has all foes of the map, and also links whose paths pass too closely.
            assert foe in listed or not either
            if either:
                assert listed[foe] == node.forbids(connections[foe], connections[mine])


def check_everything(path: Path, read: Callable[[Path], RoadNetwork] = network_of) -> None:
    network = read(path)
    check_points(network)
    check_lanes(network)
    check_links(network)
    check_conflicts(network)
    check_signals(network)
    check_against_sumolib(
        network, sumolib.net.readNet(str(path), withInternal=True, withPrograms=True)
    )


@pytest.mark.parametrize("name", MAPS)
def test_real_maps_are_read_completely(built_map: BuiltMap, name: str) -> None:
    check_everything(built_map(name))


@pytest.mark.parametrize("name", GAMES)
def test_networks_of_sumo_are_read_completely(name: str) -> None:
    check_everything(network_of_sumo(name))


@pytest.mark.parametrize(
    "options",
    [
        ["--grid", "--grid.number=4", "--default.lanenumber=2", "--tls.guess"],
        ["--spider", "--spider.arm-number=7", "--default-junction-type=allway_stop"],
        ["--rand", "--rand.iterations=30", "--seed=3", "--no-internal-links"],
    ],
)
def test_generated_networks_are_read_completely(tmp_path: Path, options: list[str]) -> None:
    sumo = pytest.importorskip("sumo")
    path = tmp_path / "made.net.xml"
    command = [str(Path(sumo.SUMO_HOME) / "bin" / "netgenerate"), *options, "-o", str(path)]
    subprocess.run(command, check=True, capture_output=True)
    check_everything(path, read_network)


@pytest.mark.parametrize("name", NOT_FOR_CARS)
def test_a_network_without_roads_is_refused(name: str) -> None:
    with pytest.raises(MapError, match="no lane that road vehicles may use"):
        read_network(network_of_sumo(name))


def test_elevation_is_kept(built_map: BuiltMap) -> None:
    bridges = network_of(built_map("xodr/Town04.xodr")).points["z"]
    hill = network_of(built_map("net/mcity/mcity.net.xml")).points["z"]
    assert (bridges.min(), bridges.max()) == pytest.approx((0.0, 11.0), abs=0.05)
    assert (hill.min(), hill.max()) == pytest.approx((266.0, 279.4), abs=0.05)
