"""Scenarios on random maps take place only where their conflict is possible."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.core.errors import ScenarioError
from cavmarl.evaluate.scenarios.scenario_runs import make_scenario, run_scenario
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.scenarios.library import load_scenario, scenario_names
from cavmarl.traffic.scenarios.streets import Streets
from tests.support.netgenerate import random_map

MAPS = 30


@pytest.mark.slow
@pytest.mark.parametrize("name", scenario_names())
@pytest.mark.parametrize("number", range(MAPS))
def test_a_driver_that_never_yields_fails_on_any_map(
    tmp_path: Path, name: str, number: int
) -> None:
    try:
        vec = make_scenario(name, random_map(tmp_path, number), seed=number)
    except ScenarioError:
        pytest.skip("the map has no place for it")
    try:
        assert run_scenario(vec, "never_yield", number).verdict == "collided"
    finally:
        vec.close()


def test_a_blockage_stands_on_the_route_of_the_agent(tmp_path: Path) -> None:
    scenario = load_scenario("intersection_blockage")
    found = 0
    for number in (0, 1, 3):
        streets = Streets(read_network(random_map(tmp_path, number)))
        places = scenario.places(streets, scenario.Parameters())
        for place in places.values():
            stop = scenario.stage(streets, place, scenario.Parameters())
            assert stop.actors
            assert streets.apart_m(place) < 1.0
        found += len(places)
    assert found > 10
