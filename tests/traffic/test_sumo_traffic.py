"""`sumo-traffic`: SUMO moves its vehicles. They are mirrored as rows and brake for agents."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_SUMO
from cavmarl.driving.kernels.lanes.route_following import next_step
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.step_trace import MIRROR, SENSORS, SUMO, TICK, StepTrace
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.shards.shard import Commands
from tests.support.driving import drive, idle
from tests.support.rerouting import CARS, make_map, passed, rerouter, sumo_passed, write_demand
from tests.support.sumo_worlds import alone, coupled, tiny_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

FLOW = '<flow id="f" type="car" from="in" to="out" begin="0" end="900" period="4"/>'
STEADY = '<vType id="car" sigma="0" speedDev="0"/>'


def mirrored(simulation: Simulation) -> np.ndarray:
    """Return the rows of SUMO's vehicles in the first world, sorted by id."""
    rows = simulation.vehicles()
    rows = rows[rows["driver"] == DRIVER_SUMO]
    return np.sort(rows, order="order")


def names(simulation: Simulation) -> list[str]:
    assert simulation.sumo is not None
    return simulation.sumo.worlds.names[0]


def test_without_agents_rows_and_signals_equal_those_of_sumo_alone(tmp_path: Path) -> None:
    """Compare positions, speeds and signals after each step with a second SUMO without a world."""
    turned = False
    with (
        coupled("grid4x4", [tiny_file(tmp_path)]) as simulation,
        alone(simulation, tmp_path) as libsumo,
    ):
        network, vehicle = simulation.network, libsumo.vehicle
        dt = simulation.config.clock.sim_dt_s
        before: dict[str, float] = {}
        for _ in range(150):
            drive(simulation)
            for _ in range(simulation.config.clock.ticks_per_step):
                before = {name: vehicle.getSpeed(name) for name in vehicle.getIDList()}
                libsumo.simulationStep()
            rows, known = mirrored(simulation), names(simulation)
            assert {known[number] for number in rows["order"]} == set(vehicle.getIDList())
            for row in rows:
                name = known[row["order"]]
                half, heading = 0.5 * row["length"], row["heading"]
                x, y, z = vehicle.getPosition3D(name)
                assert abs(row["x"] + half * math.cos(heading) - x) < 0.01
                assert abs(row["y"] + half * math.sin(heading) - y) < 0.01
                assert abs(row["z"] - z) < 0.01
                angle = math.degrees(0.5 * math.pi - heading) - vehicle.getAngle(name)
                assert abs((angle + 180.0) % 360.0 - 180.0) < 0.1
                assert row["length"] == vehicle.getLength(name)
                assert row["speed"] == vehicle.getSpeed(name)
                if name in before and row["departed"] < row["tick"] - 1:
                    assert row["accel"] == pytest.approx(
                        (row["speed"] - before[name]) / dt, abs=1e-9
                    )
                assert row["blinker"] == blinker(vehicle.getSignals(name))
                front = network.lane_ids[row["lane"]]
                turned |= front != vehicle.getLaneID(name)
            assert shown(simulation) == {
                name: libsumo.trafficlight.getRedYellowGreenState(name)
                for name in network.signal_ids
            }
    assert turned, "no vehicle had its centre on another lane than its front"


def blinker(signals: int) -> int:
    return 1 if signals & 2 else -1 if signals & 1 else 0


def shown(simulation: Simulation) -> dict[str, str]:
    """Return the state of each signal in SUMO's letters."""
    network = simulation.network
    found = {}
    for name, phase, row in zip(
        network.signal_ids, simulation.signal_phases(), network.signals, strict=True
    ):
        first = network.phases[phase]["first_state"]
        codes = network.phase_states[first : first + row["num_links"]]
        found[name] = "".join(SIGNAL_STATES[code] for code in codes)
    return found


def test_a_row_lies_on_its_lane(tmp_path: Path) -> None:
    with coupled("grid4x4", [tiny_file(tmp_path)]) as simulation:
        seen = 0
        for _ in range(100):
            drive(simulation)
            for row in mirrored(simulation):
                line = simulation.network.lane_polyline(int(row["lane"]))
                lane = simulation.network.lanes[row["lane"]]
                assert 0.0 <= row["s"] <= lane["length_m"]
                if len(line) == 2 and 2.0 < row["s"] < lane["length_m"] - 2.0:
                    along = (line[1] - line[0])[:2] / np.linalg.norm((line[1] - line[0])[:2])
                    left = np.array([-along[1], along[0]])
                    place = line[0][:2] + row["s"] * along + row["d"] * left
                    if abs(row["yaw_rate"]) < 1e-6:
                        assert np.hypot(*(place - (row["x"], row["y"]))) < 0.02
                        seen += 1
        assert seen > 500


def test_ids_and_names_are_a_bijection(tmp_path: Path) -> None:
    with coupled("grid4x4", [tiny_file(tmp_path)], agents=3) as simulation:
        forward: dict[int, str] = {}
        for _ in range(200):
            drive(simulation)
            rows, known = mirrored(simulation), names(simulation)
            for row in rows:
                assert (
                    forward.setdefault(int(row["id"]), known[row["order"]]) == (known[row["order"]])
                )
            assert len(set(rows["order"])) == len(rows)
        assert len(set(forward.values())) == len(forward) > 20
        agents = simulation.vehicles()[simulation.vehicles()["driver"] == DRIVER_AGENT]
        assert not set(agents["id"].tolist()) & forward.keys()


def test_a_vehicle_has_the_route_that_sumo_gave_it(tmp_path: Path) -> None:
    """Some of the vehicles have moved to another zone."""
    zones = {"zones.count": 4}
    with (
        coupled("grid4x4", [tiny_file(tmp_path)], overrides=zones) as simulation,
        alone(simulation, tmp_path) as libsumo,
    ):
        for _ in range(150):
            drive(simulation)
            for _ in range(simulation.config.clock.ticks_per_step):
                libsumo.simulationStep()
        compared = 0
        for row in mirrored(simulation):
            name = names(simulation)[row["order"]]
            route = libsumo.vehicle.getRoute(name)
            rest = list(route[libsumo.vehicle.getRouteIndex(name) :])
            ahead = edges_ahead(simulation, row)
            assert ahead == rest[-len(ahead) :]
            assert len(ahead) >= len(rest) - 1
            compared += row["epoch"] > 0
        assert compared > 0, "no vehicle has changed its zone"


def edges_ahead(simulation: Simulation, row: np.void) -> list[str]:
    """Return the edges from a vehicle to the end of its route, following planned lane changes."""
    network, travel = simulation.network, simulation.shards[0].travel
    lane, way, found = int(row["lane"]), int(row["way"]), []
    for _ in range(1000):
        here = network.lanes[lane]
        if not here["internal"]:
            found.append(network.edge_ids[here["edge"]])
            step = travel.steps[way + lane]
            for _ in range(8):
                if step["change"] == 0:
                    break
                lane = int(network.lanes[lane]["left" if step["change"] > 0 else "right"])
                step = travel.steps[way + lane]
        lane, way, _ = next_step(network.arrays, travel, lane, way)
        if lane < 0:
            return found
    raise AssertionError("the way does not end")


def test_different_clocks_of_sumo_and_the_world_are_an_error(tmp_path: Path) -> None:
    files = write_demand(tmp_path, STEADY + FLOW)
    (tmp_path / "late.sumocfg").write_text(
        "<configuration><input>"
        f'<route-files value="{files[0].name}"/></input><time><begin value="0:01:40"/></time>'
        "</configuration>",
        encoding="utf-8",
    )
    with coupled(make_map(tmp_path), [tmp_path / "late.sumocfg"]) as simulation:
        for _ in range(30):
            drive(simulation)
        assert simulation.sumo is not None
        assert simulation.sumo.worlds.at(0).tick == simulation.ticks()[0]
        # SUMO starts at second 100, so the flow, which begins at second 0, began 100 s earlier.
        assert demand_begin(simulation) == 100.0
        simulation.shards[0].worlds.ticks[0] += 1
        with pytest.raises(Exception, match="its SUMO at"):
            drive(simulation)


def demand_begin(simulation: Simulation) -> float:
    return simulation.shards[0].travel.begin_s


def test_sumos_cars_brake_for_an_agent_that_stands(tmp_path: Path) -> None:
    """On one lane, no vehicle touches the agent, and a queue forms behind it."""
    files = write_demand(tmp_path, STEADY + FLOW)
    origin = {"traffic.origins": ["in"], "traffic.destinations": ["out"], "clock.sim_dt_s": 0.1}
    with coupled(make_map(tmp_path), files, agents=1, overrides=origin) as simulation:
        brake = idle(simulation)
        brake.controls[..., 0] = -5.0
        for _ in range(300):
            simulation.step(brake)
        rows = simulation.vehicles()
        agent = rows[rows["driver"] == DRIVER_AGENT][0]
        others = mirrored(simulation)
        behind = others[(others["x"] < agent["x"]) & (others["lane"] == agent["lane"])]
        assert len(behind) >= 3
        gap = agent["x"] - behind["x"].max() - 0.5 * (agent["length"] + behind["length"][0])
        assert 0.5 < gap < 5.0
        assert behind["speed"].max() < 14.0
        assert behind["speed"][behind["x"].argmax()] < 0.1
        assert simulation.traffic_stats().contacts == 0


def test_agents_stop_at_signals_that_are_red_in_sumo(tmp_path: Path) -> None:
    """All signals are red in SUMO, but not in the programs of the map."""
    network = load("grid4x4")
    programs = "".join(
        f'<tlLogic id="{name}" type="static" programID="red" offset="0">'
        f'<phase duration="1000" state="{"r" * int(row["num_links"])}"/></tlLogic>'
        for name, row in zip(network.signal_ids, network.signals, strict=True)
    )
    files = [tiny_file(tmp_path), tmp_path / "red.add.xml"]
    files[1].write_text(f"<additional>{programs}</additional>", encoding="utf-8")
    with coupled("grid4x4", files, agents=8) as simulation:
        for _ in range(250):
            drive(simulation)
            assert not (simulation.outputs.events & 8).any()
        assert set("".join(shown(simulation).values())) == {"r"}
        rows = simulation.vehicles()
        agents = rows[rows["driver"] == DRIVER_AGENT]
        at_line = agents[agents["speed"] < 0.1]
        assert len(at_line) >= 4
        assert simulation.traffic_stats().arrived == 0


def load(env: str) -> object:
    from cavmarl.engine.world_setup import load_world

    return load_world(env).network


def test_a_teleport_is_counted_and_moves_no_agent(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files = write_demand(tmp_path, STEADY + FLOW)
    (tmp_path / "x.sumocfg").write_text(
        f'<configuration><input><route-files value="{files[0].name}"/></input>'
        '<processing><time-to-teleport value="10"/></processing></configuration>',
        encoding="utf-8",
    )
    origin: dict[str, Any] = {
        "traffic.origins": ["narrow"],
        "traffic.destinations": ["out"],
        "clock.sim_dt_s": 0.2,
    }
    origin["clock.ctrl_dt_s"] = 0.2
    with (
        caplog.at_level(logging.WARNING),
        coupled(
            make_map(tmp_path), [tmp_path / "x.sumocfg"], agents=1, overrides=origin
        ) as simulation,
    ):
        brake = idle(simulation)
        brake.controls[..., 0] = -5.0
        places = set()
        for step in range(500):
            simulation.step(brake)
            rows = simulation.vehicles()
            agent = rows[rows["driver"] == DRIVER_AGENT][0]
            if step > 50:
                places.add((float(agent["x"]), float(agent["y"])))
        assert simulation.sumo is not None
        assert simulation.sumo.worlds.teleports[0] > 0
        assert len(places) == 1
        stats = simulation.traffic_stats()
        assert stats.removed == simulation.sumo.worlds.teleports[0]
    assert "SUMO teleports f." in caplog.text


@pytest.mark.parametrize("source", ["sumo-traffic", "sumo-demand"])
def test_closed_edges_and_new_routes_of_sumo_take_effect(tmp_path: Path, source: str) -> None:
    """The narrow edge is closed from second 100 on; later vehicles take the long route."""
    net = make_map(tmp_path)
    cars = CARS.format(device="")
    flow = '<flow id="f" type="car" from="in" to="out" begin="0" end="300" period="6"/>'
    closed = rerouter('<closingReroute id="short"/>', span='begin="100" end="1000"')
    files = write_demand(tmp_path, cars + flow, closed)
    clock = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0, "horizon_s": 1200.0}
    with coupled(net, files, source, overrides=clock) as simulation:
        found = passed(simulation, 500)
        waiting = simulation.traffic_stats().waiting
    expected = sumo_passed(net, files, tmp_path)
    assert waiting == 0
    assert abs(found["long1"] - expected["long1"]) <= 1
    assert found["long1"] > 25
    assert abs(found["short"] - expected["short"]) <= 1


def test_an_agent_may_leave_the_road_and_the_map(tmp_path: Path) -> None:
    """SUMO keeps that agent at its position and accepts the next agent under the same name."""
    files = write_demand(tmp_path, STEADY + FLOW)
    origin = {"traffic.origins": ["in"], "traffic.destinations": ["out"], "clock.sim_dt_s": 0.1}
    with coupled(make_map(tmp_path), files, agents=1, overrides=origin) as simulation:
        wild = idle(simulation)
        wild.controls[..., 0], wild.controls[..., 1] = 5.0, 0.3
        for _ in range(100):
            simulation.step(Commands(wild.controls, wild.meta_actions))
        assert simulation.outputs.terminated.any()
        simulation.retire_agents()
        for _ in range(50):
            drive(simulation)
        assert simulation.traffic_stats().removed == 1


def test_each_step_runs_sumo_the_mirror_the_tick_and_the_sensors_in_this_order(
    tmp_path: Path,
) -> None:
    """SUMO steps to t + dt, the mirror copies its vehicles, the world ticks, sensors see t + dt."""
    own = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.1}
    with coupled("grid4x4", [tiny_file(tmp_path)], agents=1, overrides=own) as simulation:
        trace = StepTrace()
        simulation.trace(trace.around, trace.note)
        for _ in range(5):
            trace.begin()
            drive(simulation)
        assert trace.cycles == [(SUMO, MIRROR, TICK, SENSORS)] * 5
