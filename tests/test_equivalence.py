"""Divided worlds equal the undivided world bit for bit, compared through the public interface."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec, parallel_env
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import find_map
from cavmarl.env.vector import StepResult
from cavmarl.handoff import shard_setup as dividing
from cavmarl.roads.cache import load_network
from cavmarl.verify.equivalence import Equivalence, verify_zones
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.support.actuated import actuated_grid
from tests.support.demand_worlds import make, tiny
from tests.support.driving import drive, start
from tests.support.narrow_places import signal_pair, zipper
from tests.support.netgenerate import netgenerate
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, rerouter, write_demand
from tests.support.world import traffic_of

ZONES = (2, 3, 4, 9)
# The built-in driver with noise, so that some vehicles collide or leave the road.
NOISY_DRIVER = """
import numpy as np
from cavmarl.policies.policy import Policy

class NoisyDriver(Policy):
    def reset(self, seed=None):
        self.random = np.random.default_rng(seed)

    def act_batch(self, observations, mask):
        actions = self.env.suggest_actions()
        return np.clip(actions + self.random.normal(0.0, 0.3, actions.shape), -1.0, 1.0)

def make_policy(env):
    return NoisyDriver(env)
"""
FAST = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2}
SENSORS = {
    "sensors.kinematics.vehicles_count": 6,
    "sensors.occupancy_grid.features": ["presence", "vx", "on_road"],
    "sensors.lidar_observation.cells": 16,
}


@pytest.fixture(scope="module")
def noisy_driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "noisy_driver.py"
    path.write_text(NOISY_DRIVER, encoding="utf-8")
    return path


def check_equal(env: str | Path, *, crossings: int, **settings: Any) -> Equivalence:
    """Check with `verify_zones` that divided worlds are equal and vehicles cross borders."""
    overrides = FAST | dict(settings.pop("overrides", {}))
    found = verify_zones(env, settings.pop("zones", ZONES), overrides=overrides, **settings)
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == settings["steps"]
    assert sum(result.crossings for result in found.results) >= crossings
    return found


@dataclass(frozen=True)
class Case:
    """Settings of a comparison."""

    env: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    worlds: int = 1
    steps: int = 50
    seed: int = 0
    zones: tuple[int, ...] = ZONES


CASES = {
    "closed": Case("grid4x4", {"population.mode": "closed"}),
    "open": Case("merge", {"population.mode": "open"}),
    "respawn": Case("merge", {"population.mode": "respawn", "population.agents": 8}),
    "town": Case("town", {"population.background": 150}, steps=30, zones=(4, 9)),
    "worlds": Case("merge", {"population.mode": "respawn"}, worlds=3),
    "another seed": Case("grid4x4", {"population.mode": "open"}, seed=71),
    "late controls": Case("merge", {"clock.control_latency_ticks": 5}),
    "meta-actions": Case("merge", {"action.kind": "discrete"}),
    "grid of actions": Case("merge", {"action.kind": "grid"}),
    "team's rewards": Case("merge", {"terms.team_share": 0.4, "population.agents": 12}),
    "rewards of nearby agents": Case(
        "merge", {"terms.team_share": 0.4, "terms.team_range_m": 40.0, "population.agents": 12}
    ),
    "stacked frames": Case("grid4x4", {"sensors.stack": 4}, worlds=2),
    "all sensors": Case("grid4x4", SENSORS, steps=30),
    "short episodes": Case("merge", {"horizon_s": 2.0}, worlds=2),
}


@pytest.mark.parametrize("name", CASES)
def test_results_of_agents_do_not_depend_on_zones(name: str, noisy_driver: Path) -> None:
    case = CASES[name]
    check_equal(
        case.env,
        crossings=10,
        zones=case.zones,
        policy="random_actions" if name in ("meta-actions", "grid of actions") else noisy_driver,
        worlds=case.worlds,
        steps=case.steps,
        seed=case.seed,
        overrides=case.overrides,
    )


@pytest.mark.parametrize("avoid", [False, True])
@pytest.mark.parametrize("layout", ["grid", "strips", "bisection"])
def test_results_do_not_depend_on_the_layout_of_zones(
    layout: str, avoid: bool, noisy_driver: Path
) -> None:
    overrides = {"population.background": 90, "zones.avoid_junctions": avoid}
    check_equal(
        "grid4x4", crossings=10, layout=layout, policy=noisy_driver, steps=40, overrides=overrides
    )


def test_results_do_not_depend_on_narrow_zones_of_a_file(tmp_path: Path) -> None:
    # Cuts beside and through a junction; a car crosses one of the zones in a second.
    low_x, low_y, high_x, high_y = load_network(find_map("grid4x4")).extent_m
    middle_x, middle_y = 0.5 * (low_x + high_x), 0.5 * (low_y + high_y)
    cuts = [low_x - 9.0, middle_x - 8.0, middle_x, middle_x + 8.0, high_x + 9.0]
    rects = [
        [x, y, end_x, end_y]
        for x, end_x in pairwise(cuts)
        for y, end_y in ((low_y - 9.0, middle_y), (middle_y, high_y + 9.0))
    ]
    bounds = (low_x - 9.0, low_y - 9.0, high_x + 9.0, high_y + 9.0)
    path = tmp_path / "zones.json"
    write_zones(path, ZonePartition(bounds, np.array(rects)))
    overrides = {"population.background": 90}
    found = check_equal(
        "grid4x4", crossings=20, zones=None, layout=path, steps=40, overrides=overrides
    )
    assert [result.zones for result in found.results] == [8]


def test_actuated_signals_do_not_depend_on_zones(tmp_path: Path) -> None:
    check_equal(actuated_grid(tmp_path), crossings=20, zones=(4, 9), steps=60)


def test_a_real_map_with_its_demand_does_not_depend_on_zones(
    shared_maps: Path, noisy_driver: Path
) -> None:
    folder = shared_maps / "net" / "mcity"
    demand = [str(folder / "mcity.rou.xml"), str(folder / "mcity.add.xml")]
    check_equal(
        folder / "mcity.net.xml",
        crossings=20,
        zones=(4, 9),
        policy=noisy_driver,
        steps=60,
        overrides={"traffic.demand": demand, "population.mode": "respawn"},
    )


def check_same_results(one: StepResult, other: StepResult) -> None:
    for mine, theirs in zip(one[:4], other[:4], strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for key, array in one[4].items():
        np.testing.assert_array_equal(array, other[4][key], err_msg=key)


def test_autoresets_of_worlds_do_not_depend_on_zones() -> None:
    # Each world has one agent, which ends the episode by leaving the road at its own time.
    settings: dict[str, Any] = {
        "num_envs": 4,
        "agents": 1,
        "overrides": {"population.mode": "closed"} | FAST,
    }
    whole, divided = (make_vec("grid4x4", zones=zones, **settings) for zones in (1, 4))
    for vec in (whole, divided):
        vec.reset(seed=2)
    alone = 0
    for step in range(60):
        actions = whole.suggest_actions()
        np.testing.assert_array_equal(actions, divided.suggest_actions())
        actions[step % 15 // 4 :, 0] = 1.0  # full throttle, full steering
        results = [vec.step(actions) for vec in (whole, divided)]
        check_same_results(*results)
        over = results[0][4]["episode_over"]
        alone += over.any() and not over.all()
        for world in range(4):
            assert whole.state_hash(world) == divided.state_hash(world)
            assert whole.traffic_stats(world) == divided.traffic_stats(world)
    assert alone > 3


def test_results_of_parallel_environments_do_not_depend_on_zones() -> None:
    settings: dict[str, Any] = {"agents": 6, "overrides": {"population.mode": "respawn"} | FAST}
    whole, divided = (parallel_env("merge", zones=zones, **settings) for zones in (1, 4))
    (seen, infos), (other_seen, other_infos) = (env.reset(seed=4) for env in (whole, divided))
    rng = np.random.default_rng(1)
    for _ in range(50):
        assert infos == other_infos
        for agent, observation in seen.items():
            np.testing.assert_array_equal(observation, other_seen[agent])
        np.testing.assert_array_equal(whole.state(), divided.state())
        assert whole.agents == divided.agents
        agents = rng.permutation(whole.agents)
        actions = {a: rng.uniform(-1.0, 1.0, 2).astype(np.float32) for a in agents}
        seen, rewards, ended, cut, infos = whole.step(actions)
        shuffled = {agent: actions[agent] for agent in rng.permutation(agents)}
        other_seen, *others, other_infos = divided.step(shuffled)
        assert [rewards, ended, cut] == others
        assert whole.state_hash() == divided.state_hash()


# Worlds without agents have no observations, so compare the hashes of their states.
def check_equal_hashes(
    build: Callable[[dict[str, Any]], Simulation], steps: int, zones: tuple[int, ...] = ZONES
) -> Simulation:
    whole, *divided = (build({"zones.count": count}) for count in (1, *zones))
    for simulation in (whole, *divided):
        start(simulation, seed=3)
    for step in range(steps):
        for simulation in (whole, *divided):
            drive(simulation)
        for world in range(whole.num_worlds):
            for count, simulation in zip(zones, divided, strict=True):
                told = f"step {step}, world {world}, {count} zones"
                assert simulation.state_hash(world) == whole.state_hash(world), told
                assert simulation.traffic_stats(world) == whole.traffic_stats(world), told
    return whole


@pytest.mark.parametrize("env", ["merge", "grid4x4"])
def test_departures_of_demand_do_not_depend_on_zones(env: str, tmp_path: Path) -> None:
    whole = check_equal_hashes(lambda zones: tiny(env, tmp_path, overrides=FAST | zones), 350)
    assert whole.traffic_stats().departed > 30


def test_the_capacity_of_a_world_does_not_depend_on_zones(tmp_path: Path) -> None:
    most = 9

    def build(zones: dict[str, Any]) -> Simulation:
        simulation = tiny("merge", tmp_path, overrides=FAST | zones)
        vars(traffic_of(simulation))["capacity"] = most
        return simulation

    whole = check_equal_hashes(build, 150, (2, 4))
    assert whole.traffic_stats().running == most
    assert whole.traffic_stats().waiting > 5


def test_routes_of_rerouted_vehicles_do_not_depend_on_zones(tmp_path: Path) -> None:
    net = make_map(tmp_path)
    files = write_demand(
        tmp_path, CARS.format(device=DEVICE) + FLOW, rerouter('<closingReroute id="narrow"/>')
    )
    clock = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0, "horizon_s": 1200.0}
    whole = check_equal_hashes(
        lambda zones: make(net, files, num_worlds=2, overrides=clock | zones), 200, (2, 4)
    )
    assert whole.traffic_stats().rerouted > 20


LONG_ROAD = """<?xml version="1.0" encoding="UTF-8"?>
<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,0,0" origBoundary="0,0,0,0" projParameter="!"/>
  <edge id="road" from="W" to="E">
    <lane id="road_0" index="0" speed="14" length="3000" shape="0,0,0 3000,0,0"/>
  </edge>
  <junction id="W" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>
  <junction id="E" type="dead_end" x="3000" y="0" incLanes="road_0" intLanes="" shape=""/>
</net>"""
BEHIND_THE_LAST = """<routes>
  <vType id="car" sigma="0.5"/><route id="r" edges="road"/>
  <vehicle id="first" type="car" route="r" depart="0" departPos="40">
    <stop lane="road_0" endPos="120" duration="40"/>
  </vehicle>
  <flow id="f" type="car" route="r" begin="1" end="60" period="9" departPos="last"/>
</routes>"""


def test_a_departure_behind_the_last_vehicle_does_not_depend_on_zones(tmp_path: Path) -> None:
    # The zone at the end of the road decides the position; another zone has the last vehicle.
    on_a_long_road(tmp_path, BEHIND_THE_LAST)


def on_a_long_road(tmp_path: Path, routes: str) -> Simulation:
    road, demand = tmp_path / "long.net.xml", tmp_path / "x.rou.xml"
    road.write_text(LONG_ROAD, encoding="utf-8")
    demand.write_text(routes, encoding="utf-8")
    return check_equal_hashes(
        lambda zones: make(road, [demand], overrides=FAST | zones), 300, (2, 4)
    )


TURNING_ROUND = """<routes>
  <vType id="bus" vClass="bus" length="12" width="2.5" sigma="0.5"/><vType id="car" sigma="0.5"/>
  {flows}
</routes>"""
TURNS = ("A1B1 B1A1", "C1B1 B1C1", "B0B1 B1B0", "B2B1 B1B2")
BETWEEN = ("A1B1 B1C1", "C1B1 B1B2", "B0B1 B1A1", "B2B1 B1B0", "B1A1 A1A2", "B1C1 C1C0")
AT_DEAD_ENDS = ("B0A0 A0left0 left0A0 A0A1", "A1B1 B1top1 top1B1 B1B0")
FROM_DEAD_ENDS = (
    *("left0A0 A0A1", "left0A0 A0B0 B0right0", "top1B1 B1right1", "B0A0 A0left0"),
    *("top1B1 B1B0 B0bottom1", "right0B0 B0A0", "top0A1 A1A0", "bottom1B0 B0B1"),
)


@pytest.mark.parametrize(
    ("grid", "buses", "cars"),
    [
        # Departures at the start of a lane behind a junction depend on vehicles on the junction.
        ("--grid.number=3 -j=allway_stop", TURNS, (*TURNS, *BETWEEN)),
        # At dead ends, vehicles depart on lanes to which no link leads. Left turns wait.
        ("--grid.number=2 --grid.attach-length=90 -j=priority", AT_DEAD_ENDS, FROM_DEAD_ENDS),
    ],
)
def test_effects_of_turning_buses_do_not_depend_on_zones(
    tmp_path: Path, grid: str, buses: tuple[str, ...], cars: tuple[str, ...]
) -> None:
    options = ("--grid", "--grid.length=110", "-L=2", *grid.split())
    net = netgenerate(tmp_path / "grid.net.xml", *options)
    ways = {"bus": (buses, 11), "car": (cars, 4)}
    flows = "".join(
        f'<flow id="{kind}{n}" type="{kind}" begin="{n}" end="100" period="{period}">'
        f'<route edges="{edges}"/></flow>'
        for kind, (routes, period) in ways.items()
        for n, edges in enumerate(routes)
    )
    demand = tmp_path / "turns.rou.xml"
    demand.write_text(TURNING_ROUND.format(flows=flows), encoding="utf-8")
    whole = check_equal_hashes(lambda zones: make(net, [demand], overrides=FAST | zones), 500)
    assert whole.traffic_stats().departed > 100


@pytest.mark.parametrize("narrow", [zipper, signal_pair])
def test_traffic_at_narrow_places_does_not_depend_on_zones(
    narrow: Callable[[Path], tuple[Path, Path]], tmp_path: Path
) -> None:
    net, routes = narrow(tmp_path)
    whole = check_equal_hashes(
        lambda zones: make(net, [routes], overrides=FAST | zones), 400, (2, 4)
    )
    assert whole.traffic_stats().departed > 20


SLOW_AT_THE_START = """<routes>
  <vType id="slow" maxSpeed="8" sigma="0"/><vType id="car"/><route id="r" edges="road"/>
  <vehicle id="first" type="slow" route="r" depart="0" departPos="2700"/>
  <flow id="b" type="slow" route="r" begin="0" end="100" period="9" departSpeed="max"/>
  <flow id="f" type="car" route="r" begin="1" end="100" period="9" departPos="last"/>
</routes>"""


def test_the_speed_of_a_departure_behind_the_last_vehicle_does_not_depend_on_zones(
    tmp_path: Path,
) -> None:
    # The slow vehicles that enter at the start are in another zone than the departure.
    assert on_a_long_road(tmp_path, SLOW_AT_THE_START).traffic_stats().departed > 5


def test_lane_changes_at_solid_lines_do_not_depend_on_zones(tmp_path: Path) -> None:
    path = netgenerate(tmp_path / "grid.net.xml", "--grid", "--grid.number", "3", "-L", "2")
    barred = re.sub(r'(id="[AC][0-2][A-C][0-2]_0")', r'\1 changeLeft="bus"', path.read_text())
    path.write_text(re.sub(r'(id="B[0-2][A-C][0-2]_1")', r'\1 changeRight="bus"', barred))
    check_equal(path, zones=(2, 4), steps=60, crossings=20, overrides={"population.background": 60})


@pytest.mark.parametrize("halo_m", [0.0, 12.0])
def test_verify_zones_finds_the_difference_of_a_halo_that_is_too_narrow(
    halo_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dividing, "halo_m", lambda *_: halo_m)
    overrides = FAST | {"population.background": 90}
    found = verify_zones("grid4x4", (4,), steps=40, overrides=overrides)
    difference = found.results[0].difference
    assert not found.holds
    assert difference is not None
    assert difference.values[0] != difference.values[1]
