"""A scenario does not depend on borders of zones, even if a border crosses its place."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.records.codes import DRIVER_SCRIPTED
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.scenarios.scenario_runs import make_scenario
from cavmarl.policies.loading import load_policy
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.traffic.test_scenarios import NAMES, ROOMY

STEPS = 75
CUTS = {2: (2, 1), 4: (2, 2), 9: (3, 3)}  # columns and rows of zones


def cut_through(vec: CavVectorEnv, path: Path, count: int) -> Path:
    """Write a zone file with a border, or a corner of four zones, in the middle of the scene."""
    scene, extent = vec.simulation.scene, vec.network.extent_m
    assert scene is not None
    low_x, low_y, high_x, high_y = extent
    columns, lines = CUTS[count]
    across = [low_x, scene.x, 0.5 * (scene.x + high_x), high_x]
    along = [low_y, scene.y, 0.5 * (scene.y + high_y), high_y]
    across, along = [*across[:columns], high_x], [*along[:lines], high_y]
    rects = [[x, y, to_x, to_y] for y, to_y in pairwise(along) for x, to_x in pairwise(across)]
    write_zones(path, ZonePartition(extent, np.array(rects)))
    return path


def hashes(vec: CavVectorEnv, driver: str = "idm", steps: int = STEPS) -> list[str]:
    """Return the state hash after each step, until the agent has left."""
    observations, infos = vec.reset(seed=0)
    policy = load_policy(driver, vec)
    found = [vec.state_hash()]
    for _ in range(steps):
        results = vec.step(policy.act_batch(observations, infos["mask"]))
        observations, infos = results[0], results[4]
        found.append(vec.state_hash())
        if infos["episode_over"][0]:
            break
    return found


def divided(name: str, path: Path, count: int, whole: CavVectorEnv, **keys: Any) -> CavVectorEnv:
    file = cut_through(whole, path / f"{count}.json", count)
    overrides = {"zones.layout": str(file), "zones.check_invariants": True, **keys}
    return make_scenario(name, density="low", zones=count, overrides=overrides)


@pytest.mark.parametrize("name", NAMES)
def test_a_border_through_the_scene_changes_nothing(name: str, tmp_path: Path) -> None:
    whole = make_scenario(name, density="low")
    expected = hashes(whole)
    for count in CUTS:
        vec = divided(name, tmp_path, count, whole)
        assert hashes(vec) == expected
        assert vec.simulation.partition.count == count


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("count", "agents"), [(2, 1), (9, 3)])
def test_workers_change_no_result_in_scenarios(
    name: str, count: int, agents: int, tmp_path: Path
) -> None:
    place = ROOMY.get(name, "")
    whole = make_scenario(name, density="low", agents=agents, place=place)
    expected = hashes(whole, steps=60)
    file = cut_through(whole, tmp_path / f"{count}.json", count)
    keys = {
        "zones.layout": str(file), "scenario.name": name,
        "scenario.seed": whole.config.scenario.seed, "scenario.place": place,
        "population.mode": "closed", "population.budget": None, "action.kind": "continuous",
        "horizon_s": whole.config.horizon_s,
    }  # fmt: skip
    vec = make_vec(
        "grid4x4", zones=count, workers=2, agents=agents, overrides=keys,
        background=whole.config.population.background, autoreset_mode="NextStep",
    )  # fmt: skip
    try:
        assert hashes(vec, steps=60) == expected
    finally:
        vec.close()


@pytest.mark.parametrize("name", NAMES)
def test_several_agents_are_independent_of_zones(name: str, tmp_path: Path) -> None:
    place = ROOMY.get(name, "")
    whole = make_scenario(name, density="low", agents=3, place=place)
    expected = hashes(whole, steps=50)
    file = cut_through(whole, tmp_path / "4.json", 4)
    overrides = {"zones.layout": str(file), "zones.check_invariants": True}
    vec = make_scenario(name, density="low", agents=3, place=place, zones=4, overrides=overrides)
    assert hashes(vec, steps=50) == expected


def test_a_vehicle_that_turns_on_a_border_keeps_its_owner(tmp_path: Path) -> None:
    """A car turns where four zones meet; the hysteresis keeps the car in one zone."""
    whole = make_scenario("failed_u_turn")
    steady, restless = (
        divided("failed_u_turn", tmp_path, 4, whole, **{"zones.hysteresis_m": hysteresis_m})
        for hysteresis_m in (whole.config.zones.hysteresis_m, 0.0)
    )
    owners, crossings = owners_of_turning_car(steady)
    assert crossings >= 2
    assert len(set(owners)) == 1
    owners, again = owners_of_turning_car(restless)
    assert again == crossings
    changes = sum(here != before for before, here in pairwise(owners))
    assert 2 <= changes <= crossings


def owners_of_turning_car(vec: CavVectorEnv) -> tuple[list[int], int]:
    """Return the owner of the turning car at each step, and how often it crosses a border."""
    _, infos = vec.reset(seed=0)
    policy = load_policy("idm", vec)
    rows, scene = vec.simulation.vehicles(), vec.simulation.scene
    assert scene is not None
    car = int(rows["id"][rows["driver"] == DRIVER_SCRIPTED][0])
    owners, places = [], []
    for _ in range(80):
        vec.step(policy.act_batch(np.zeros((1, 1, 0), np.float32), infos["mask"]))
        rows = vec.simulation.vehicles()
        row = rows[rows["id"] == car][0]
        owners.append(int(row["owner"]))
        places.append((bool(row["x"] >= scene.x), bool(row["y"] >= scene.y)))
    return owners, sum(here != before for before, here in pairwise(places))
