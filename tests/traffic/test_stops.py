"""Vehicles on bundled maps make their stops and take another route if necessary."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cavmarl.engine.simulation import Simulation
from tests.support.demand_worlds import make
from tests.support.driving import drive, start
from tests.support.world import tick_of

DT = 0.1
World = Callable[..., Simulation]


@pytest.fixture
def world(tmp_path: Path) -> World:
    """Return a function that makes a world from the elements inside <routes>, and resets it."""

    def build(body: str, env: str = "merge") -> Simulation:
        path = tmp_path / "x.rou.xml"
        path.write_text(f"<routes>{body}</routes>", encoding="utf-8")
        clock = {"clock.sim_dt_s": DT, "clock.ctrl_dt_s": DT}
        simulation = make(env, [path], overrides=clock)
        start(simulation, seed=0)
        return simulation

    return build


def car(stops: str, depart: float = 0.0, lane: str = "0") -> str:
    return (
        '<vType id="c" sigma="0" speedDev="0"/>'
        f'<vehicle id="v" type="c" depart="{depart}" departLane="{lane}" departSpeed="max">'
        f'<route edges="main_in weave main_out"/>{stops}</vehicle>'
    )


def stands(simulation: Simulation, seconds: float) -> list[tuple[float, float, str, float]]:
    """Drive, and return (begin in s, end in s, lane, position of the front) of each stop."""
    found: list[tuple[float, float, str, float]] = []
    standing = False
    for _ in range(round(seconds / DT)):
        drive(simulation)
        rows = simulation.vehicles()
        now = len(rows) == 1 and rows[0]["speed"] < 0.1
        time = float(simulation.ticks()[0]) * DT
        if now:
            begun = found.pop()[0] if standing else time
            front = float(rows[0]["s"] + 0.5 * rows[0]["length"])
            found.append((begun, time, simulation.network.lane_ids[rows[0]["lane"]], front))
        standing = now
    return found


def test_a_vehicle_stands_at_its_stop_for_its_duration_and_arrives(world: World) -> None:
    simulation = world(car('<stop lane="main_in_0" endPos="200" duration="10"/>'))
    (stand,) = stands(simulation, 90.0)
    begun, ended, lane, front = stand
    assert lane == "main_in_0"
    assert 197.0 <= front <= 200.5
    assert ended - begun == pytest.approx(10.0, abs=2.0 * DT)
    assert simulation.traffic_stats().arrived == 1


@pytest.mark.parametrize(("until", "leaves"), [(50.0, 50.0), (5.0, None)])
def test_a_vehicle_leaves_no_sooner_than_its_timetable(
    world: World, until: float, leaves: float | None
) -> None:
    stop = f'<stop lane="main_in_0" endPos="200" duration="4" until="{until}"/>'
    (stand,) = stands(world(car(stop)), 70.0)
    begun, ended, _, _ = stand
    if leaves is None:
        assert ended - begun == pytest.approx(4.0, abs=2.0 * DT), (
            "a late vehicle does not leave after the duration"
        )
    else:
        assert ended == pytest.approx(leaves, abs=2.0 * DT)


def test_the_driver_changes_to_the_lane_of_its_stop_and_stays_there(world: World) -> None:
    simulation = world(car('<stop lane="main_in_0" endPos="250" duration="5"/>', lane="1"))
    (stand,) = stands(simulation, 90.0)
    assert stand[2] == "main_in_0"
    assert simulation.traffic_stats().arrived == 1


def test_a_vehicle_makes_its_stops_in_their_order(world: World) -> None:
    stops = (
        '<stop lane="main_in_1" endPos="120" duration="3"/>'
        '<stop lane="weave_1" endPos="100" duration="4"/>'
        '<stop lane="main_out_0" endPos="150" duration="5"/>'
    )
    simulation = world(car(stops))
    found = stands(simulation, 119.0)
    assert [lane for _, _, lane, _ in found] == ["main_in_1", "weave_1", "main_out_0"]
    lasted = [ended - begun for begun, ended, _, _ in found]
    assert lasted == pytest.approx([3.0, 4.0, 5.0], abs=2.0 * DT)
    assert simulation.traffic_stats().arrived == 1


def test_a_vehicle_beyond_its_stop_drives_on(world: World) -> None:
    simulation = world(car('<stop lane="main_in_0" endPos="200" duration="10"/>'))
    while not len(simulation.vehicles()):
        drive(simulation)
    row = simulation.vehicles()[0]
    row["s"] = 240.0
    assert stands(simulation, 60.0) == []
    assert simulation.traffic_stats().arrived == 1


def test_vehicles_pass_a_vehicle_that_stands_on_another_lane(world: World) -> None:
    simulation = world(
        car('<stop lane="main_in_0" endPos="200" duration="60"/>')
        + '<flow id="f" type="c" from="main_in" to="main_out" begin="5" end="60" period="4"'
        ' departLane="0"/>'
    )
    for _ in range(round(75.0 / DT)):
        drive(simulation)
        assert (simulation.vehicles()["hit"] < 0).all()
    assert simulation.traffic_stats().arrived >= 3
    assert 0 in simulation.vehicles()["id"], "the first vehicle has left"


def test_a_vehicle_that_cannot_change_lanes_takes_another_route(world: World) -> None:
    simulation = world(
        '<vType id="c" sigma="0" speedDev="0"/>'
        '<vehicle id="v" type="c" depart="0">'
        '<route edges="A1B1 B1C1 C1D1 D1D2 D2D3 D3right3"/></vehicle>',
        "grid4x4",
    )
    network, travel = simulation.network, simulation.travel
    # Drivers consider another route once per second.
    while not len(simulation.vehicles()) or simulation.ticks()[0] % round(1.0 / DT):
        drive(simulation)
    row = simulation.vehicles()[0]
    edge = network.edges[network.lanes[row["lane"]]["edge"]]
    lanes = range(int(edge["first_lane"]), int(edge["first_lane"] + edge["num_lanes"]))
    (wrong,) = (k for k in lanes if travel.steps[row["way"] + k]["change"] != 0)
    for waited, times in ((44.0, 0), (46.0, 1)):
        row = simulation.vehicles()[0]
        row["lane"] = row["target_lane"] = wrong
        row["s"], row["speed"] = network.lanes[wrong]["length_m"] - 4.0, 0.0
        row["wait_s"] = waited
        worlds = simulation.shards[0].worlds
        worlds.next_rows[0, 0] = row
        tick_of(simulation).leave()
        assert simulation.traffic_stats().rerouted == times
        worlds.rows[0, 0] = worlds.next_rows[0, 0]
    row = simulation.vehicles()[0]
    assert row["way"] == travel.first_detour + row["goal"] * len(network.lanes)
    assert row["leg"] == 1
    assert travel.steps[row["way"] + wrong]["change"] == 0
    last = -1
    for _ in range(round(400.0 / DT)):
        drive(simulation)
        for row in simulation.vehicles():
            last = int(network.lanes[row["lane"]]["edge"])
    assert simulation.traffic_stats().arrived == 1
    assert network.edge_ids[last] == "D3right3"
