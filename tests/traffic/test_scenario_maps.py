"""Scenarios on maps drawn by chance: staged only where their conflict exists."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.core.errors import ScenarioError
from cavmarl.evaluate.scenarios.scenario_runs import make_scenario, run_scenario
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.scenarios.library import load_scenario, scenario_names
from cavmarl.traffic.scenarios.streets import Streets
from tests.support.netgenerate import netgenerate

JUNCTIONS = ("priority", "traffic_light", "right_before_left", "allway_stop")
MAPS = 30


def _random_map(folder: Path, number: int) -> Path:
    common = ["-L", str(1 + number % 2), "-j", JUNCTIONS[number // 3 % 4], "--seed", str(number)]
    kinds = (
        ["--rand", "--rand.iterations", "40"],
        ["--grid", "--grid.number", str(3 + number % 4), "--grid.length", str(100 + 5 * number)],
        ["--spider", "--spider.arm-number", str(4 + number % 5), "--spider.omit-center", "true"],
    )
    return netgenerate(folder / "random.net.xml", *kinds[number % 3], *common)


@pytest.mark.slow
@pytest.mark.parametrize("name", scenario_names())
@pytest.mark.parametrize("number", range(MAPS))
def test_a_driver_that_never_yields_fails_on_any_map(
    tmp_path: Path, name: str, number: int
) -> None:
    try:
        vec = make_scenario(name, _random_map(tmp_path, number), seed=number)
    except ScenarioError:
        pytest.skip("the map has no place for it")
    try:
        assert run_scenario(vec, "never_yield", number).verdict == "collided"
    finally:
        vec.close()


def test_a_blockage_stands_on_the_way_that_it_blocks(tmp_path: Path) -> None:
    scenario = load_scenario("intersection_blockage")
    found = 0
    for number in (0, 1, 3):
        streets = Streets(read_network(_random_map(tmp_path, number)))
        places = scenario.places(streets, scenario.Parameters())
        for place in places.values():
            stop = scenario.stage(streets, place, scenario.Parameters())
            assert stop.actors
            assert streets.apart_m(place) < 1.0
        found += len(places)
    assert found > 10
