"""Left-hand traffic: reading maps, mirrored driving and mirrored scenarios."""

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import MapError
from cavmarl.roads.cache import load_network
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.scenarios.library import scenario_names
from tests.support import demand_worlds
from tests.support.driving import drive, make_simulation, make_traffic, start, suggested
from tests.support.mirrored import mirror_net
from tests.support.netgenerate import netgenerate

GRID = ["--grid", "--grid.number", "3", "--grid.length", "120", "--no-turnarounds.except-deadend"]
TWO_LANES = ["-L", "2", "--lefthand"]
NETS = {
    "grid": ["--grid", "--grid.number", "3", "--grid.length", "150", *TWO_LANES],
    "spider": ["--spider", "--spider.arm-number", "5", "--spider.circle-number", "2", *TWO_LANES],
    "random": ["--rand", "--rand.iterations", "40", "--seed", "4", *TWO_LANES],
}
ROUTES = """<routes>
  <flow id="left" from="A1B1" to="B1B2" begin="0" end="60" period="6" departLane="first"/>
  <flow id="right" from="A1B1" to="B1B0" begin="0" end="60" period="7" departLane="2"/>
  <flow id="best" from="B0B1" to="B1A1" begin="0" end="60" period="8" departLane="best"/>
  <vehicle id="stops" depart="1" departLane="2"><route edges="C1B1 B1A1"/>
    <stop lane="C1B1_0" endPos="60" duration="5"/></vehicle>
</routes>"""
MIRRORED = {"x": 1.0, "y": -1.0, "s": 1.0, "d": -1.0, "speed": 1.0, "to_go": 1.0}


def test_neighbour_lanes_are_on_the_side_given_by_the_map(tmp_path: Path) -> None:
    network = read_network(netgenerate(tmp_path / "left.net.xml", *NETS["random"]))
    assert network.left_hand
    beside = np.flatnonzero(network.lanes["right"] >= 0)
    assert beside.size > 100
    for lane in beside:
        row = network.lanes[lane]
        assert network.lanes["left"][row["right"]] == lane
        assert network.lanes["index"][row["right"]] == row["index"] + 1
        x, y, *_ = network.pose_on(lane, 0.5 * row["length_m"])
        assert network.beside(row["right"], x, y)[1] > 1.0  # lateral distance, positive to the left


def test_u_turns_are_recognized_on_both_sides(tmp_path: Path) -> None:
    directions = [
        np.sort(read_network(netgenerate(tmp_path / f"{n}.net.xml", *options)).links["direction"])
        for n, options in enumerate((["--grid", "-L", "2"], ["--grid", *TWO_LANES]))
    ]
    assert directions[0].tolist() == directions[1].tolist()
    assert ord("t") in directions[0]


def test_the_cache_keeps_the_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path))
    path = netgenerate(tmp_path / "left.net.xml", *NETS["grid"])
    made, restored = load_network(path), load_network(path)
    assert made.left_hand
    assert restored.left_hand
    assert made.content_hash == restored.content_hash


def test_an_invalid_side_is_refused(tmp_path: Path) -> None:
    path = netgenerate(tmp_path / "left.net.xml", *NETS["grid"])
    path.write_text(path.read_text().replace('lefthand="true"', 'lefthand="both"'))
    with pytest.raises(MapError, match="lefthand='both'"):
        read_network(path)


@pytest.mark.parametrize("junctions", ["priority", "traffic_light", "right_before_left"])
def test_vehicles_in_a_mirrored_world_move_as_mirror_images(tmp_path: Path, junctions: str) -> None:
    plain = netgenerate(tmp_path / "right.net.xml", *GRID, "-j", junctions)
    mirror = mirror_net(plain, tmp_path / "left.net.xml")
    worlds = [make_traffic(path, background=25) for path in (plain, mirror)]
    for world in worlds:
        start(world, 3)
    for _ in range(600):
        right, left = (np.sort(world.vehicles(0), order="id") for world in worlds)
        for field, sign in MIRRORED.items():
            np.testing.assert_array_equal(right[field], sign * left[field], err_msg=field)
        for world in worlds:
            drive(world)


def test_agents_in_a_mirrored_world_steer_to_the_other_side(tmp_path: Path) -> None:
    plain = netgenerate(tmp_path / "right.net.xml", *GRID)
    mirror = mirror_net(plain, tmp_path / "left.net.xml")
    worlds = [make_simulation(path, mode="respawn", agents=9) for path in (plain, mirror)]
    for world in worlds:
        start(world, 3)
    most_rad = 0.0
    for _ in range(300):
        right, left = (suggested(world) for world in worlds)
        # Angles are wrapped upwards, so mirrored angles are equal except for rounding.
        np.testing.assert_allclose(right, left * [1.0, -1.0], atol=1e-6)
        most_rad = max(most_rad, float(np.abs(right[..., 1]).max()))
        for world in worlds:
            drive(world)
    assert most_rad > 0.3


@pytest.mark.parametrize("net", NETS)
def test_drivers_on_the_left_touch_nothing(tmp_path: Path, net: str) -> None:
    world = make_traffic(netgenerate(tmp_path / "left.net.xml", *NETS[net]), background=60)
    start(world, 1)
    for _ in range(1200):
        drive(world)
        assert (world.vehicles(0)["hit"] < 0).all()
    assert (world.vehicles(0)["distance_m"] > 100.0).mean() > 0.5


@pytest.mark.parametrize("name", scenario_names())
def test_scenarios_on_the_left_are_mirror_images(tmp_path: Path, name: str) -> None:
    plain = netgenerate(tmp_path / "right.net.xml", *GRID, "-j", "traffic_light", "-L", "1")
    mirror = mirror_net(plain, tmp_path / "left.net.xml")
    worlds = [
        make_simulation(
            path, mode="respawn", agents=1, background=0, overrides={"scenario.name": name}
        )
        for path in (plain, mirror)
    ]
    for world in worlds:
        start(world, 0)
    right, left = (np.sort(world.vehicles(0), order="id") for world in worlds)
    assert right.size > 1
    for field in ("x", "y", "s"):
        np.testing.assert_allclose(right[field], MIRRORED[field] * left[field], atol=1e-9)


def test_routes_with_lane_changes_and_stops_work_in_left_hand_traffic(
    tmp_path: Path,
) -> None:
    plain = netgenerate(tmp_path / "right.net.xml", *GRID, "-L", "3")
    mirror = mirror_net(plain, tmp_path / "left.net.xml")
    routes = tmp_path / "routes.rou.xml"
    routes.write_text(ROUTES, encoding="utf-8")
    found = []
    for path in (plain, mirror):
        clock = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.5}
        world = demand_worlds.make(path, [routes], overrides=clock)
        start(world, 3)
        stopped_s = 0.0
        for _ in range(200):
            drive(world)
            stopped_s = max(stopped_s, float(world.vehicles()["stopped_s"].max(initial=0.0)))
        stats = world.traffic_stats()
        found.append((stats.departed, stats.waiting, stats.arrived, round(stopped_s)))
    assert found[0] == found[1]
    assert found[0][2] > 5, "no vehicle arrived"
    assert found[0][3] > 3, "no vehicle stood at its stop"
