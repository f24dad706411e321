"""Each scenario on two maps: the reference driver passes, and `never_yield` fails."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import CavmarlError, ConfigError, PolicyError
from cavmarl.core.records.codes import DRIVER_SCRIPTED
from cavmarl.driving.kernels.junctions.gaps import link_signal
from cavmarl.env.parallel import parallel_env
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.scenarios.scenario_runs import ScenarioRun, make_scenario, run_scenario
from cavmarl.policies.loading import load_policy
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.traffic.scenarios.library import load_scenario, scenario_names, summary_of
from cavmarl.traffic.scenarios.scene import describe

NAMES = (
    "failed_u_turn", "intersection_blockage", "merge_conflict", "pedestrian_crossing",
    "road_closure", "signal_outage", "unprotected_left_turn",
)  # fmt: skip
VARIANTS: tuple[tuple[str, Mapping[str, bool | float]], ...] = (
    *((name, {}) for name in NAMES),
    ("pedestrian_crossing", {"occluded": True}),
)
# Places that have a road behind the first agent; the randomly drawn places have none.
ROOMY = {"failed_u_turn": "A1B1_1", "pedestrian_crossing": "A1B1_0"}
# Hashes of runs of the reference driver on grid4x4 with seed 0, without other traffic.
GOLDEN = {
    ("failed_u_turn", False): "8c96686d6f7f4c3fb7618e14c20de981",
    ("intersection_blockage", False): "8076b53af2bd13a47b5420ae08f51132",
    ("merge_conflict", False): "ab0d9157919a39a12c4311264c6b7dd0",
    ("pedestrian_crossing", False): "d9ea21caeb1504be3cb9b7ae9c1e6289",
    ("pedestrian_crossing", True): "2bdf5731261a74ff181a519b9daf6bfd",
    ("road_closure", False): "b9fb1c3a9ac665f5cda1b278541baf69",
    ("signal_outage", False): "e6dd0ced6cdf7682f6a0cdc530f0cb84",
    ("unprotected_left_turn", False): "7d6b6502fb4cc9cfa8a9417e431b66bb",
}


@contextmanager
def made(name: str, env: str | Path = "grid4x4", **settings: Any) -> Iterator[CavVectorEnv]:
    vec = make_scenario(name, env, **settings)
    try:
        yield vec
    finally:
        vec.close()


def played(name: str, driver: str, seed: int = 0, **settings: Any) -> ScenarioRun:
    with made(name, seed=seed, **settings) as vec:
        return run_scenario(vec, driver, seed)


def test_each_scenario_of_the_folder_is_listed_and_described() -> None:
    assert scenario_names() == list(NAMES)
    for name in NAMES:
        assert summary_of(name).endswith(".")
        assert load_scenario(name).NEEDS
        for _, default, allowed, what in describe(load_scenario(name).Parameters):
            assert all((default, allowed, what))


@pytest.mark.parametrize(("name", "params"), VARIANTS)
@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_the_reference_driver_passes_and_a_driver_that_never_yields_fails(
    name: str, params: Mapping[str, bool | float], seed: int
) -> None:
    found = played(name, "idm", seed, params=params)
    assert (found.verdict, found.collisions) == ("passed", 0)
    assert (found.pet_s or 0.0) > 0.5
    assert found.delay_s > 0.5
    careless = played(name, "never_yield", seed, params=params)
    assert careless.verdict == "collided"
    assert (careless.min_ttc_s, careless.pet_s) == (0.0, 0.0)
    assert careless.delay_s == pytest.approx(0.2, abs=0.2)  # the driver kept its speed
    assert careless.place == found.place


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_idm_passes_and_never_yield_collides_in_a_town(name: str, seed: int) -> None:
    assert played(name, "idm", seed, env="town").verdict == "passed"
    assert played(name, "never_yield", seed, env="town").verdict == "collided"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "params"), VARIANTS)
@pytest.mark.parametrize("density", ["low", "high"])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_idm_passes_and_never_yield_collides_in_traffic(
    name: str, params: Mapping[str, bool | float], density: str, seed: int
) -> None:
    found = played(name, "idm", seed, density=density, params=params)
    assert (found.verdict, found.background > 0) == ("passed", True)
    assert played(name, "never_yield", seed, density=density, params=params).verdict == "collided"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "params"), VARIANTS)
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4])
def test_idm_passes_and_never_yield_collides_on_a_real_map(
    name: str, params: Mapping[str, bool | float], seed: int, shared_maps: Path
) -> None:
    env = shared_maps / "net/bologna_acosta/acosta_buslanes.net.xml"
    assert played(name, "idm", seed, env=env, params=params).verdict == "passed"
    assert played(name, "never_yield", seed, env=env, params=params).verdict == "collided"


def test_no_vehicle_between_two_lanes_of_a_bend_is_off_the_road(shared_maps: Path) -> None:
    """The lanes at this place have a gap of millimetres between them, which counts as road."""
    env = shared_maps / "net/bologna_acosta/acosta_buslanes.net.xml"
    assert played("intersection_blockage", "idm", env=env, place="85_1").verdict == "passed"


@pytest.mark.parametrize(("name", "occluded"), GOLDEN)
def test_a_run_has_the_recorded_hash(name: str, occluded: bool) -> None:
    params = {"occluded": True} if occluded else {}
    assert played(name, "idm", params=params).state_hash == GOLDEN[name, occluded]


def test_a_longer_blockage_causes_a_longer_delay() -> None:
    short, long = (
        played("intersection_blockage", "idm", params={"blocked_s": blocked_s})
        for blocked_s in (6.0, 40.0)
    )
    assert long.delay_s > short.delay_s + 20.0


def test_a_longer_closure_causes_a_longer_delay() -> None:
    short, long = (
        played("road_closure", "idm", params={"closed_s": closed_s}) for closed_s in (8.0, 60.0)
    )
    assert (short.verdict, long.verdict) == ("passed", "passed")
    assert long.delay_s > short.delay_s + 30.0


def test_all_lanes_of_a_closed_road_are_closed() -> None:
    with made("road_closure") as vec:
        scene, lanes = vec.simulation.scene, vec.network.lanes
        assert scene is not None
        vec.reset(seed=0)
        rows = vec.simulation.vehicles()
        vans = rows[rows["driver"] == DRIVER_SCRIPTED]
        edge = int(lanes["edge"][vans["lane"][0]])
        assert set(vans["lane"].tolist()) == set(np.flatnonzero(lanes["edge"] == edge).tolist())
        assert len(vans) == 2
        assert edge not in (scene.seat.goal_edge, lanes["edge"][scene.seat.lane])


def test_signals_that_fail_are_dark_from_then_on() -> None:
    with made("signal_outage", params={"dark_s": 2.0}) as vec:
        scene, network = vec.simulation.scene, vec.network
        assert scene is not None
        (outage,) = scene.outages
        signal = network.signal_ids.index(outage.signal)
        links = network.links["signal"] == signal
        shown = []
        vec.reset(seed=0)
        for _ in range(40):
            phase = vec.simulation.signal_phases().copy()
            letters = [link_signal(network.arrays, k, phase) for k in np.flatnonzero(links)]
            shown.append({SIGNAL_STATES[letter] for letter in letters})
            vec.step(np.zeros((1, 1, 2), np.float32))
    step_s = vec.step_s
    for k, letters in enumerate(shown):
        assert (letters <= {"o", "O"}) == (k * step_s > 2.0 - 0.01)
    assert shown[-1] == {"o", "O"}


def test_the_seed_draws_the_place_unless_a_place_is_given() -> None:
    places = {seed: played("pedestrian_crossing", "never_yield", seed).place for seed in range(4)}
    assert len(set(places.values())) > 1
    again = played("pedestrian_crossing", "never_yield", 0, place=places[3])
    assert again.place == places[3]


BROKEN: tuple[tuple[dict[str, Any], type[CavmarlError], str], ...] = (
    ({"name": "pedestrian_crosing"}, ConfigError, "did you mean pedestrian_crossing"),
    ({"place": "nowhere"}, ConfigError, "scenario.place = 'nowhere': not one of the"),
    ({"env": "ring"}, ConfigError, "has no place for it; it needs a straight road"),
    ({"params": {"walk_mp": 1.0}}, ConfigError, "did you mean walk_mps"),
    ({"params": {"walk_mps": 9.0}}, ConfigError, "must be 0.5 to 3 m/s"),
    ({"params": {"walk_mps": True}}, ConfigError, "must be 0.5 to 3 m/s"),
    ({"params": {"occluded": 1.0}}, ConfigError, "must be true or false"),
    ({"density": "dense"}, ConfigError, "must be one of none, low, high"),
)


@pytest.mark.parametrize(("given", "error", "says"), BROKEN)
def test_invalid_arguments_are_refused(
    given: dict[str, Any], error: type[CavmarlError], says: str
) -> None:
    with pytest.raises(error, match=says):
        make_scenario(**{"scenario": given.pop("name", "pedestrian_crossing"), **given})


@pytest.mark.parametrize("name", NAMES)
def test_several_agents_enter_the_scene_one_after_the_other(name: str) -> None:
    place = ROOMY.get(name, "")
    found = played(name, "idm", agents=3, place=place)
    assert (found.verdicts, found.verdict) == (("passed",) * 3, "passed")
    assert (found.agents, found.collisions) == (3, 0)
    careless = played(name, "never_yield", agents=3, place=place)
    assert (careless.verdict, careless.verdicts[0]) == ("collided", "collided")


def test_the_first_of_several_agents_starts_at_the_place_of_a_single_agent() -> None:
    starts = []
    for agents in (1, 3):
        with made("unprotected_left_turn", agents=agents, density="high") as vec:
            vec.reset(seed=0)
            rows = vec.simulation.vehicles()
            own = np.sort(rows[rows["agent"] >= 0], order="agent")
            assert own["agent"].tolist() == list(range(agents))
            starts.append(own)
            others = rows[rows["agent"] < 0]
            for row in own[1:]:
                off_m = np.hypot(others["x"] - row["x"], others["y"] - row["y"])
                assert off_m.min() > 5.0
    for name in ("x", "y", "heading", "speed", "lane", "goal"):
        assert starts[0][name][0] == starts[1][name][0]


def test_agents_of_a_parallel_env_are_in_the_scene() -> None:
    keys = {"scenario.name": "road_closure", "population.mode": "closed",
            "population.budget": None}  # fmt: skip
    env = parallel_env("grid4x4", agents=3, background=0, overrides=keys)
    env.reset(seed=0)
    for _ in range(5):
        assert len(env.agents) == 3
        env.step(env.suggest_actions())


def test_a_scene_limits_the_number_of_agents() -> None:
    with pytest.raises(ConfigError, match=r"population\.agents = 400: .* set at most \d+"):
        make_scenario("merge_conflict", agents=400)
    with pytest.raises(ConfigError, match=r"population\.agents = 0: must be 1 or more"):
        make_vec("grid4x4", agents=0, overrides={"scenario.name": "failed_u_turn"})
    with pytest.raises(ConfigError, match="must name a scenario"):
        make_vec("grid4x4", overrides={"scenario.place": "left1A1_0"})


def test_the_driver_that_never_yields_refuses_discrete_actions() -> None:
    discrete = {"action.kind": "discrete"}
    with made("pedestrian_crossing", overrides=discrete) as vec, pytest.raises(PolicyError):
        load_policy("never_yield", vec)


OWN = '''"""The scene is empty."""
from dataclasses import dataclass
from cavmarl.traffic.scenarios.scene import Scene, Seat
from cavmarl.traffic.scenarios.scene import setting

NEEDS = "a straight road"

@dataclass(frozen=True)
class Parameters:
    speed_mps: float = setting(8.0, 3.0, 12.0, "m/s", "speed of the agent")

def places(streets, parameters):
    return {streets.name(lane): lane for lane in streets.straights(80.0)}

def stage(streets, place, parameters):
    x, y, _ = streets.point(place, 40.0)
    seat = Seat(place, 10.0, parameters.speed_mps, streets.edge(place))
    return Scene(streets.name(place), x, y, seat, [])
'''


def test_a_file_can_add_a_scenario(tmp_path: Path) -> None:
    path = tmp_path / "nobody.py"
    path.write_text(OWN, encoding="utf-8")
    found = played(str(path), "never_yield", params={"speed_mps": 10.0})
    assert (found.verdict, found.min_ttc_s, found.pet_s) == ("passed", None, None)
    path = tmp_path / "broken.py"
    path.write_text("NEEDS = 1 / 0", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"broken\.py, line 1: ZeroDivisionError"):
        make_scenario(str(path))
    path = tmp_path / "half.py"
    path.write_text("NEEDS = 'a road'", encoding="utf-8")
    with pytest.raises(ConfigError, match="not a scenario; define Parameters, places, stage"):
        make_scenario(str(path))


def test_worlds_with_a_scenario_are_independent() -> None:
    """Each world equals a single world, for any actions in other worlds."""
    keys = {"scenario.name": "pedestrian_crossing", "population.mode": "closed",
            "population.budget": None, "action.kind": "continuous"}  # fmt: skip
    one, three = (make_vec("grid4x4", num_envs=n, agents=1, background=20, overrides=keys)
                  for n in (1, 3))  # fmt: skip
    one.reset(seed=4)
    three.reset(seed=4)
    actions = np.zeros((3, 1, 2), np.float32)
    actions[1:, 0, 0] = 0.3, -1.0
    for _ in range(20):
        one.step(actions[:1])
        three.step(actions)
        assert one.state_hash() == three.state_hash(0)
    assert len({three.state_hash(w) for w in range(3)}) == 3
