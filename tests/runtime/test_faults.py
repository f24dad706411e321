"""AT1 to AT8 of the acceptance tests, on whole worlds: nobody can tell who computed what."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.roads.cache import load_network
from cavmarl.roads.zone_file import write_zones
from cavmarl.roads.zones import ZonePartition
from cavmarl.runtime.fault_plan import Faults
from cavmarl.worlds import find_map
from tests.actuated import actuated_grid
from tests.demand_worlds import make, tiny
from tests.driving import drive, start
from tests.faulted import BUSY, QUICK, ROUGH, Recorded, record, replay
from tests.rerouting import CARS, DEVICE, FLOW, make_map, rerouter, write_demand

STEPS = 20


@pytest.fixture(scope="module")
def busy() -> Recorded:
    return record("grid4x4", BUSY, STEPS)


def patchwork(seed: int, count: int) -> ZonePartition:
    """Rectangles cut anywhere, each at random: a zone says nothing about its neighbours."""
    low_x, low_y, high_x, high_y = load_network(find_map("grid4x4")).extent_m
    bounds = (low_x - 9.0, low_y - 9.0, high_x + 9.0, high_y + 9.0)
    rng = np.random.default_rng(seed)
    rects = [list(bounds)]
    while len(rects) < count:
        rect = rects.pop(int(rng.integers(len(rects))))
        axis = int(rng.integers(2))
        cut = float(rng.uniform(rect[axis], rect[axis + 2]))
        below, above = rect.copy(), rect.copy()
        below[axis + 2] = above[axis] = cut
        rects += [below, above]
    return ZonePartition(bounds, np.array(rects)[rng.permutation(count)])


@pytest.mark.parametrize("layout", ["grid", "strips", "bisection"])
@pytest.mark.parametrize("zones", [2, 3, 9, 16])
def test_at01_any_number_of_zones_in_any_layout(busy: Recorded, layout: str, zones: int) -> None:
    replay(busy, zones, settings={"zones.layout": layout})


@pytest.mark.parametrize("seed", [0, 1])
def test_at01_owners_that_chance_has_dealt_out(busy: Recorded, seed: int, tmp_path: Path) -> None:
    path = tmp_path / "patchwork.json"
    write_zones(path, patchwork(seed, 24))
    vec = replay(busy, 24, ROUGH, {"zones.layout": str(path)})
    assert len(vec.simulation.revivals) > 5


CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "several frames, late controls": (
        "grid4x4", {**BUSY, "sensors.stack": 3, "clock.control_latency_ticks": 3}),
    "one tick a step": ("grid4x4", {**BUSY, "clock.ctrl_dt_s": 0.2}),
    "agents that enter": ("merge", {**QUICK, "population.mode": "entering"}),
    "closed": ("merge", {**QUICK, "population.mode": "closed"}),
    "short episodes": ("grid4x4", {**BUSY, "horizon_s": 1.2}),
    "team's rewards": ("grid4x4", {**BUSY, "terms.team_share": 0.4}),
    "no deferral": ("grid4x4", {**BUSY, "zones.max_deferred_ticks": 0}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_at02_whatever_a_world_keeps_is_kept_over_deaths(name: str) -> None:
    env, settings = CASES[name]
    run = record(env, settings, STEPS, seed=3)
    vec = replay(run, 4, ROUGH)
    again = replay(run, 4, replace(ROUGH, seed=6))
    deaths = (*vec.simulation.revivals, *again.simulation.revivals)
    assert {death.zone is None for death in deaths} == {True, False}


def test_at02_actuated_signals_switch_alike(tmp_path: Path) -> None:
    run = record(actuated_grid(tmp_path), {**QUICK, "population.background": 40}, 60)
    vec = replay(run, 4, ROUGH)
    assert len(vec.simulation.revivals) > 5


def same_hashes(build: Any, steps: int, zones: int, faults: Faults) -> Any:
    """Worlds without agents have no public view: their hashes are compared."""
    whole, divided = build({}), build({"zones.count": zones, "zones.faults": faults.to_json()})
    for simulation in (whole, divided):
        start(simulation, seed=3)
    for step in range(steps):
        for simulation in (whole, divided):
            drive(simulation)
        assert divided.state_hash() == whole.state_hash(), f"step {step}"
        assert divided.traffic_stats() == whole.traffic_stats(), f"step {step}"
    assert len(divided.revivals) > 5
    return whole


def test_at02_vehicles_that_look_for_their_way_find_the_same(tmp_path: Path) -> None:
    net = make_map(tmp_path)
    files = write_demand(
        tmp_path, CARS.format(device=DEVICE) + FLOW, rerouter('<closingReroute id="narrow"/>')
    )
    clock = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0, "horizon_s": 1200.0}
    whole = same_hashes(lambda zones: make(net, files, overrides=clock | zones), 150, 3, ROUGH)
    assert whole.traffic_stats().rerouted > 10


@pytest.mark.parametrize("env", ["merge", "grid4x4"])
def test_at02_whatever_a_demand_orders_enters_alike(env: str, tmp_path: Path) -> None:
    whole = same_hashes(
        lambda zones: tiny(env, tmp_path, overrides={**QUICK, **zones}), 120, 4, ROUGH
    )
    assert whole.traffic_stats().departed > 20
