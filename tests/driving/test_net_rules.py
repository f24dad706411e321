"""Background drivers at yellow, on minor roads, in slow lane changes and at the end of a trip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.codes import EVENT_ARRIVED, HOLD_NONE, HOLD_SIGNAL, MODEL_KRAUSS
from cavmarl.driving.kernels.junctions.gaps import is_minor
from cavmarl.driving.kernels.junctions.junctions import hold_at_line
from cavmarl.driving.kernels.motion.motion import move_background
from cavmarl.driving.vehicle_types import set_model
from cavmarl.engine.simulation import Simulation
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.demand_worlds import make
from tests.support.driving import drive, start
from tests.support.netgenerate import netgenerate
from tests.support.traffic import network as entry_network
from tests.support.traffic import on_lane, scratch, travel

GRID = ("--grid", "--grid.number=3", "--grid.length=100", "--no-turnarounds.except-deadend")
CLOCK = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.1, "horizon_s": 120.0}
ALONE = """<routes>
  <vType id="car" sigma="0"/>
  <vehicle id="one" type="car" depart="0" departSpeed="max" departLane="best">
    <route edges="B0B1 B1B2"/></vehicle>
</routes>"""


def test_krauss_stops_for_yellow_if_its_deceleration_suffices() -> None:
    roads = entry_network("grid4x4")
    link = int(np.flatnonzero(roads.links["signal"] >= 0)[0])
    yellow = SIGNAL_STATES.index("y")
    states = np.array(roads.phase_states)
    states[:] = yellow
    arrays = roads.arrays._replace(phase_states=states)
    phase = roads.signals["program"].astype(np.int32)
    phase[:] = 0
    lane = int(roads.links[link]["from_lane"])
    length_m = float(roads.lanes["length_m"][lane])
    room, decel = scratch(roads, 1), 4.5
    types = np.array(travel("grid4x4").types)
    set_model(types, MODEL_KRAUSS)
    types["decel"] = decel
    tables = travel("grid4x4")._replace(types=types)
    back_m = float(roads.lanes["stop_back_m"][lane])
    for needs, holds in ((0.9 * decel, HOLD_SIGNAL), (1.1 * decel, HOLD_NONE)):
        front_m = 10.0**2 / (2.0 * needs)
        row = on_lane(roads, lane, length_m - front_m - back_m - 2.5, speed=10.0, length=5.0)
        distance = length_m - float(row["s"][0])
        held = hold_at_line(arrays, tables, row, 0, link, distance, 0, phase, room)
        assert held == holds


def only(path: Path, routes: Path) -> Simulation:
    """Return a started world with the demand of a file that has a single vehicle."""
    world = make(path, [routes], overrides=CLOCK)
    start(world, 1)
    return world


@pytest.mark.parametrize(("junctions", "slows"), [("priority", False), ("right_before_left", True)])
def test_a_yielding_driver_approaches_slowly_enough_to_stop(
    tmp_path: Path, junctions: str, slows: bool
) -> None:
    path = netgenerate(tmp_path / "net.net.xml", *GRID, "-j", junctions)
    network = read_network(path)
    minor = is_minor_to(network, "B0B1_0", "B1B2_0")
    routes = tmp_path / "one.rou.xml"
    routes.write_text(ALONE, encoding="utf-8")
    world = only(path, routes)
    slowest = np.inf
    for _ in range(300):
        drive(world)
        rows = world.vehicles()
        if rows.size:
            slowest = min(slowest, float(rows["speed"].min()))
    limit = float(network.lanes["speed_mps"].max())
    assert minor == slows or junctions == "priority"
    assert (slowest < 0.75 * limit) == minor
    assert slowest > 1.0, "the car stopped without a foe"


def test_a_left_turn_is_slow_before_its_waiting_position(tmp_path: Path) -> None:
    """As in SUMO, the car slows down until 4.5 m before the position, where it sees no foe."""
    path = netgenerate(tmp_path / "net.net.xml", *GRID, "-j", "traffic_light")
    network = read_network(path)
    links = network.links
    (turn,) = np.flatnonzero(
        (links["from_lane"] == network.lane_ids.index("B0B1_0")) & (links["direction"] == ord("l"))
    )
    goal = network.edge_ids[network.lanes["edge"][links["to_lane"][turn]]]
    routes = tmp_path / "one.rou.xml"
    routes.write_text(ALONE.replace("B1B2", goal), encoding="utf-8")
    world = only(path, routes)
    lane = links["from_lane"][turn]
    place_m = float(network.lanes["length_m"][lane] + links["wait_m"][turn])
    slowest = np.inf, 0.0
    for _ in range(600):
        drive(world)
        for row in world.vehicles()[world.vehicles()["lane"] == lane]:
            to_place_m = place_m - float(row["s"] + 0.5 * row["length"])
            if row["wait_s"] == 0.0 and 0.0 < to_place_m < 10.0:
                slowest = min(slowest, (float(row["speed"]), to_place_m))
    assert 5.0 < slowest[0] < 7.0
    assert 3.5 < slowest[1] < 4.5


def is_minor_to(network: RoadNetwork, before: str, after: str) -> bool:
    pair = (network.lane_ids.index(before), network.lane_ids.index(after))
    links = network.links
    link = np.flatnonzero((links["from_lane"] == pair[0]) & (links["to_lane"] == pair[1]))[0]
    phase = np.zeros(max(len(network.signals), 1), np.int32)
    return bool(is_minor(network.arrays, int(link), phase))


@pytest.mark.parametrize(("speed", "sideways_mps"), [(0.0, 0.5), (1.0, 0.5), (10.0, 1.4)])
def test_a_lane_change_continues_at_a_standstill(speed: float, sideways_mps: float) -> None:
    tables, roads = travel("grid4x4"), entry_network("grid4x4")
    row = on_lane(roads, 0, 10.0, speed=speed, d=1.0)
    move_background(roads.arrays, tables, row[0], tables.steps[0], 0.0, 0, 0.1)
    assert row["d"][0] == pytest.approx(1.0 - 0.1 * sideways_mps)


@pytest.mark.parametrize("length", [5.0, 12.0])
def test_a_trip_of_a_background_vehicle_ends_5_m_before_the_end_of_the_road(
    length: float,
) -> None:
    tables, roads = travel("grid4x4"), entry_network("grid4x4")
    steps, lengths = tables.steps[: len(roads.lanes)], roads.lanes["length_m"]
    goal = int(np.flatnonzero((steps["next"] < 0) & (steps["to_go"] == lengths))[0])
    end_m = float(lengths[goal])
    for front_m, arrived in ((6.0, False), (4.9, True)):
        row = on_lane(roads, goal, end_m - front_m - 0.5 * length, speed=1.0, length=length)
        move_background(roads.arrays, tables, row[0], tables.steps[goal], 0.0, 0, 0.1)
        assert bool(row["events"][0] & EVENT_ARRIVED) == arrived
