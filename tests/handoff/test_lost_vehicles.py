"""Other drivers ignore an agent that leaves its lane and drives against the traffic."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.records.codes import DRIVER_AGENT, EVENT_WRONG_WAY
from cavmarl.core.records.rows import LOST_M
from cavmarl.engine.simulation import Simulation
from cavmarl.shards.shard import Commands
from tests.support.borders import cut_at, write_roads
from tests.support.demand_worlds import make
from tests.support.driving import idle, start

TICK_S = 0.1
STREET = "road0"  # along y = 0; the agent starts here
CROSSED = [((200.0 + 3.2 * k, -900.0), (200.0 + 3.2 * k, 30.0)) for k in range(8)]
BOUNDS = (-10.0, -910.0, 410.0, 40.0)
WAY = [(203.0, 0.0), (214.0, -8.0), (216.0, -30.0), (216.0, -1000.0)]
STOPS_Y_M = -720.0  # farther from the street than the halo of any zone
SLOW_MPS, FAST_MPS = 5.0, 30.0


@pytest.fixture
def worlds(tmp_path: Path) -> tuple[Simulation, Simulation]:
    """Return a street across a one-way road of eight lanes, undivided and in three zones."""
    net = write_roads(tmp_path / "x.net.xml", [((0.0, 0.0), (400.0, 0.0)), *CROSSED], 15.0)
    cars = "".join(
        f'<vehicle id="{k}" type="car" depart="{30 + 4 * k}"><route edges="{STREET}"/></vehicle>'
        for k in range(12)
    )
    demand = tmp_path / "x.rou.xml"
    demand.write_text(f'<routes><vType id="car" sigma="0"/>{cars}</routes>', encoding="utf-8")
    layout = cut_at(tmp_path / "zones.json", BOUNDS, [], [-300.0, -100.0])

    def build(**zones: Any) -> Simulation:
        overrides = {"clock.sim_dt_s": TICK_S, "clock.ctrl_dt_s": TICK_S, "horizon_s": 120.0}
        return make(net, [demand], agents=1, overrides=overrides | zones)

    return build(), build(**{"zones.layout": str(layout), "zones.count": 3})


def agent_of(simulation: Simulation) -> np.void:
    rows = simulation.vehicles(0)
    found: np.void = rows[rows["driver"] == DRIVER_AGENT][0]
    return found


class WrongWayDriver:
    """Turn left into the wrong lanes of the other road, and stop far away."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self._reached = 0

    def step(self) -> None:
        row = agent_of(self.simulation)
        x, y = WAY[self._reached]
        if math.hypot(x - row["x"], y - row["y"]) < 8.0:
            self._reached += 1
            x, y = WAY[self._reached]
        error = math.remainder(math.atan2(y - row["y"], x - row["x"]) - row["heading"], math.tau)
        speed = SLOW_MPS
        if self._reached == len(WAY) - 1:
            speed = FAST_MPS if row["y"] > STOPS_Y_M else 0.0
        still = idle(self.simulation)
        controls = still.controls.copy()
        controls[0, 0] = np.clip(2.0 * (speed - row["speed"]), -4.0, 3.0), 1.5 * error
        self.simulation.step(Commands(controls, still.meta_actions))
        self.simulation.retire_agents()


def begins_on_the_street(simulation: Simulation, seed: int) -> bool:
    start(simulation, seed)
    row = agent_of(simulation)
    return bool(row["lane"] == 0 and row["s"] < 150.0)


def test_a_lost_vehicle_blocks_no_lane_in_any_division(
    worlds: tuple[Simulation, Simulation],
) -> None:
    whole, divided = worlds
    seed = next(seed for seed in range(100) if begins_on_the_street(whole, seed))
    start(divided, seed)
    drivers = WrongWayDriver(whole), WrongWayDriver(divided)
    for _ in range(700):
        for driver in drivers:
            driver.step()
        assert divided.state_hash(0) == whole.state_hash(0)
    row = agent_of(whole)
    assert row["speed"] < 1e-6
    assert row["events"] & EVENT_WRONG_WAY
    assert abs(row["d"]) > LOST_M
    away_m = -row["y"]
    assert away_m > divided.zones.loads().halo_m
    street = whole.vehicles(0)
    passed = (street["driver"] != DRIVER_AGENT) & (street["s"] > row["s"])
    assert passed.sum() >= 3, "fewer than three vehicles have passed the agent"


def test_the_built_in_driver_looks_for_its_lane(worlds: tuple[Simulation, Simulation]) -> None:
    whole, divided = worlds
    seed = next(seed for seed in range(100) if begins_on_the_street(whole, seed))
    start(divided, seed)
    drivers = WrongWayDriver(whole), WrongWayDriver(divided)
    for _ in range(250):
        for driver in drivers:
            driver.step()
    told = []
    for simulation in worlds:
        raw = np.full((1, 1, 2), np.nan)
        simulation.suggest(raw)
        told.append(raw)
    assert agent_of(whole)["speed"] > SLOW_MPS
    assert told[0][0, 0, 0] < 0.0, "the built-in driver does not brake"
    assert told[0].tobytes() == told[1].tobytes()
