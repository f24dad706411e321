"""The benchmark `yardstick`: its counts, its bound, and the reasons why vehicles stand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from benchmarks import yardstick
from cavmarl.bench.harness import BenchmarkReport
from cavmarl.core.errors import ConfigError
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.roads.sumo_net import reader
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.netgenerate import netgenerate


def test_the_bound_holds_on_a_correct_map() -> None:
    found = yardstick.measure(["merge"], agents="2", models="IDM", seconds=30)
    assert found.holds
    (own, total) = found.rows
    assert own["map"] == "merge"
    assert total["map"] == "all"
    assert own["trips"] == total["trips"] >= 2
    assert own["off_road"] == own["collision"] == own["stands"] == 0


def test_the_label_of_a_map_is_its_file_name_or_its_path_if_two_names_are_equal() -> None:
    here, there = "/some/long/folder/Town01.xodr", "/another/Town01.net.xml"
    assert yardstick.labels(["town", here]) == {"town": "town", here: "Town01"}
    assert yardstick.labels([here, there]) == {here: here, there: there}


def test_the_table_has_room_for_all_columns_on_a_narrow_terminal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(yardstick, "drive", lambda *_: yardstick.Drive(trips=1234))
    name = "/maps/of/a/far/folder/bologna_buslanes.net.xml"
    found = yardstick.measure([name], agents="100", models="Krauss")
    console = Console(width=80, record=True)
    BenchmarkReport(found.title, found.columns, found.rows).show(console)
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= 80
    (own,) = (line.split() for line in lines if line.split()[:1] == ["bologna_buslanes"])
    assert own == ["bologna_buslanes", "Krauss", "100", "1234", *["0.00"] * 5, "0"]


def test_contacts_on_shared_ground_are_counted_separately(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test disables the repair by which the reader of networks moves such lanes apart."""
    monkeypatch.setattr(reader, "find_strips", lambda *_: [])
    options = ("--grid", "--grid.number=3", "--grid.length=80", "--default.spreadtype=center")
    network = read_network(netgenerate(tmp_path / "bidi.net.xml", *options))
    ground = yardstick.SharedGround(network)
    one, other = yardstick.shared_ground(network)[0]
    rows = np.zeros(3, dtype=VEHICLE)
    rows["id"], rows["lane"], rows["x"] = [0, 1, 2], [one, other, one], [0.0, 4.0, 50.0]
    assert ground.holds(rows[0], rows, 0.1)
    assert ground.holds(rows[1], rows, 0.1)
    rows["x"] = [0.0, 50.0, 4.0]  # the near vehicle is on the same lane
    assert not ground.holds(rows[0], rows, 0.1)
    rows["x"], rows["z"] = (
        [0.0, 2.0, 4.0],
        [0.0, 5.0, 0.0],
    )  # the near vehicle on the other lane is on a bridge
    assert not ground.holds(rows[0], rows, 0.1)
    rows["x"] = [0.0, 50.0, 50.0]  # no other vehicle is near
    assert ground.holds(rows[0], rows, 0.1)
    # The centre of the vehicle behind is nearer, but the contact is with the oncoming vehicle.
    rows["z"], rows["length"], rows["width"] = 0.0, 5.0, 2.0
    rows["x"], rows["speed"] = [0.0, 8.0, -6.0], [15.0, 15.0, 0.0]
    rows["heading"][1] = np.pi
    assert ground.holds(rows[0], rows, 0.1)


def test_the_bound_allows_few_vehicles_off_the_road_and_none_on_the_wrong_way() -> None:
    one = yardstick.Drive(trips=2000)
    one.counts["off_road"] = 1
    assert one.holds, "the bound does not allow that 0.05 % of the trips leave the road"
    one.counts["off_road"] = 2
    assert not one.holds
    one.counts["off_road"] = 0
    one.counts["wrong_way"] = 1
    assert not one.holds


def test_a_red_signal_and_a_vehicle_ahead_are_reasons_to_stand() -> None:
    world = load_world("grid4x4", agents=2, background=0)
    vec = CavVectorEnv(LocalWorlds(world, 1))
    vec.reset(seed=1)
    rows = vec.simulation.vehicles(0)
    rows["wait_s"] = [yardstick.STANDS_S, 0.0]
    rows["x"][1] = rows["x"][0] + 500.0 * np.cos(rows["heading"][0])
    rows["y"][1] = rows["y"][0] + 500.0 * np.sin(rows["heading"][0])
    watch = yardstick.StandingVehicles(vec)
    red = np.zeros(len(vec.network.links), dtype=np.uint8)
    red[:] = yardstick.SIGNAL_STATES.index("r")
    green = np.full(len(vec.network.links), yardstick.SIGNAL_STATES.index("G"), dtype=np.uint8)
    assert watch.has_cause(rows, 0, red)
    assert not watch.has_cause(rows, 0, green)
    rows["x"][1] = rows["x"][0] + 8.0 * np.cos(rows["heading"][0])
    rows["y"][1] = rows["y"][0] + 8.0 * np.sin(rows["heading"][0])
    assert watch.has_cause(rows, 0, green)


def test_foes_with_priority_and_a_full_road_are_reasons_to_stand() -> None:
    vec = CavVectorEnv(LocalWorlds(load_world("town", agents=2, background=0), 1))
    vec.reset(seed=1)
    network, watch = vec.network, yardstick.StandingVehicles(vec)
    others = vec.simulation.vehicles(0)[1:]
    yields = np.flatnonzero(network.conflicts["must_yield"] & ~network.conflicts["merging"])
    link = int(np.searchsorted(network.links["first_conflict"], yields[0], side="right")) - 1
    foe = network.links[network.conflicts["foe"][yields[0]]]

    def waits(lane: int, s: float) -> bool:
        others["lane"], others["s"] = lane, s
        return watch.gives_way(others, link)

    assert waits(foe["from_lane"], network.lanes["length_m"][foe["from_lane"]] - 5.0)
    assert waits(foe["next_lane"], 0.5)
    others["length"] = 5.0
    assert waits(foe["to_lane"], 2.0), "a vehicle with its rear in the junction is no cause"
    assert not waits(foe["to_lane"], 3.0)
    behind = network.links["to_lane"][link]
    assert waits(behind, 5.0)
    assert not waits(behind, yardstick.NEAR_AHEAD_M + 1.0)


def test_a_vehicle_inside_a_junction_waits_for_room_and_not_for_a_signal() -> None:
    vec = CavVectorEnv(LocalWorlds(load_world("grid4x4", agents=2, background=0), 1))
    vec.reset(seed=1)
    network, rows = vec.network, vec.simulation.vehicles(0)
    link = int(np.flatnonzero(network.links["first_internal"] >= 0)[0])
    rows["x"], rows["y"] = [0.0, 500.0], 0.0
    rows["lane"] = network.links[["first_internal", "to_lane"]][link].tolist()
    watch = yardstick.StandingVehicles(vec)
    red = np.full(len(network.links), yardstick.SIGNAL_STATES.index("r"), dtype=np.uint8)
    rows["s"] = 5.0
    assert watch.has_cause(rows, 0, red)
    rows["s"][1] = yardstick.NEAR_AHEAD_M + 1.0
    assert not watch.has_cause(rows, 0, red)


def test_a_call_without_a_map_is_refused() -> None:
    with pytest.raises(ConfigError, match="no map: give maps"):
        yardstick.measure()
