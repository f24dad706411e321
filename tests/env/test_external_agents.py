"""External vehicles with `observes=True` are agents of PettingZoo and have sensors."""

from __future__ import annotations

import copy
import math
import warnings
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from cavmarl import ActionError, CavEnv, ConfigError, parallel_env
from tests.env.test_external_commands import place_on

with warnings.catch_warnings():  # PettingZoo's test module imports deprecated environments
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test

RIG = {
    "roof": {"type": "lidar", "rate_hz": 10, "rays": 24, "range_m": 40.0},
    "imu": {"type": "imu", "rate_hz": 20, "noise": [0.1]},
}
SETTINGS = {
    "population.external": 3,
    "population.external_agents": True,
    "clock.ctrl_dt_s": 0.05,
    "rig": RIG,
}


def ring(background: int = 8, **more: Any) -> CavEnv:
    overrides = SETTINGS | more.pop("overrides", {})
    env = parallel_env("ring", agents=1, background=background, overrides=overrides, **more)
    env.reset(seed=1)
    return env


def advance(env: CavEnv, steps: int = 1, **actions: Any) -> tuple[Any, ...]:
    for _ in range(steps):
        found = env.step({**env.suggest_actions(), **actions})
    return found


def test_an_observing_vehicle_is_an_agent_while_it_is_in_the_world() -> None:
    with closing(ring()) as env:
        assert env.possible_agents == ["car_0", "external_0", "external_1", "external_2"]
        silent = env.external.spawn(*place_on(env, 0))
        x, y, heading = place_on(env, 1)
        slot = env.external.spawn(x, y, heading, observes=True)
        assert (silent, slot) == (0, 1)
        assert env.agents == ["car_0"]
        observations, rewards, terminations, truncations, infos = advance(env)
        assert env.agents == ["car_0", "external_1"]
        for found in (observations, rewards, terminations, truncations, infos):
            assert list(found) == ["car_0", "external_1"]
        assert env.observation_space("external_1").contains(observations["external_1"])
        assert infos["external_1"]["vehicle_id"] == env.external.ids()[1]
        assert rewards["external_1"] == 0.0
        env.external.remove(slot)
        _, _, terminations, _, infos = advance(env)
        assert terminations["external_1"]
        assert infos["external_1"] == {"active": 0.0, "vehicle_id": -1}
        assert env.agents == ["car_0"]
        assert "external_1" not in advance(env)[0]


def test_sensors_of_an_observing_vehicle_see_the_traffic_and_do_not_change_it() -> None:
    ranges, states = [], []
    for observes in (True, False):
        with closing(ring()) as env:
            x, y, heading = place_on(env, 0)
            aside = x + 6.0 * math.sin(heading), y - 6.0 * math.cos(heading)
            slot = env.external.spawn(*aside, heading, observes=observes)
            for _ in range(100):
                advance(env)
                if observes:
                    ranges.append(env.frames(f"external_{slot}")["roof"].data.min())
            rows = env.simulation.vehicles(0)
            states.append(np.sort(rows, order="id").tobytes())
            assert env.agents == (["car_0", f"external_{slot}"] if observes else ["car_0"])
    assert min(ranges) < 10.0 < max(ranges)  # vehicles pass close to the sensor
    assert states[0] == states[1]


def test_samples_measure_the_distance_to_another_car_and_the_speed_of_the_car_itself() -> None:
    """The centres of both cars are 12 m apart, so the rear of the car ahead is 9.5 m away."""
    rig = {"roof": RIG["roof"] | {"rate_hz": 20}, "wheels": {"type": "odometry", "rate_hz": 20}}
    with closing(ring(background=0, overrides={"rig": rig})) as env:
        min_x, min_y, _, _ = env.network.extent_m
        slot = env.external.spawn(min_x - 50.0, min_y, 0.0, observes=True)
        env.external.spawn(min_x - 38.0, min_y, 0.0)
        observations = advance(env)[0]
        assert observations["external_0"]["roof"].min() == pytest.approx(9.5, abs=0.1)
        env.external.pose(slot, min_x - 49.6, min_y, 0.0)
        observations = advance(env)[0]
        assert observations["external_0"]["roof"].min() == pytest.approx(9.1, abs=0.1)
        assert observations["external_0"]["wheels"][0] == pytest.approx(8.0)


def run(**more: Any) -> list[bytes]:
    """Return all samples of two observing vehicles that drive through a world."""
    overrides = SETTINGS | {"population.external": 2}
    env = parallel_env("grid4x4", agents=2, background=20, overrides=overrides, **more)
    with closing(env):
        env.reset(seed=2)
        for k in (3, 5):
            env.external.spawn(*place_on(env, k, 12.0), speed=8.0, observes=True)
        found = []
        for _ in range(40):
            actions = {**env.suggest_actions(), "external_0": np.array([0.2, 0.01], np.float32)}
            if "external_0" not in env.agents:
                del actions["external_0"]
            observations = env.step(actions)[0]
            for agent in sorted(set(observations) & {"external_0", "external_1"}):
                found += [observations[agent][name].tobytes() for name in RIG]
        assert len(found) == 40 * 2 * len(RIG)
    return found


def test_samples_do_not_depend_on_zones_or_workers() -> None:
    undivided = run()
    assert run(zones=4) == undivided
    assert run(zones=4, workers=2) == undivided


def test_an_observing_vehicle_keeps_its_last_action_and_refuses_invalid_actions() -> None:
    with closing(ring()) as env:
        slot = env.external.spawn(*place_on(env, 0), observes=True)
        advance(env)
        advance(env, external_0=np.array([0.5, 0.0], np.float32))
        advance(env, 9)
        (row,) = env.external.vehicles()
        assert row["order"] == slot
        assert row["speed"] == pytest.approx(0.5 * env.config.action.acceleration_mps2 * 0.5)
        before = env.state_hash()
        for action, match in (
            ([0.0], "must be two numbers"),
            ([[0.0], [0.0, 1.0]], "must be two numbers"),
            ([2.0, 0.0], "must be two numbers"),
            ([math.nan, 0.0], "must be two numbers"),
        ):
            with pytest.raises(ActionError, match=match):
                advance(env, external_0=action)
        with pytest.raises(ActionError, match="external_1: is not in the world"):
            advance(env, external_1=[0.0, 0.0])
        assert env.state_hash() == before


def test_actions_of_absent_vehicles_can_be_ignored() -> None:
    with closing(ring(overrides={"action.late_actions": "ignore"})) as env:
        before = env.state_hash()
        advance(env, external_1=[0.5, 0.0])
        assert env.state_hash() != before
        assert env.agents == ["car_0"]


def test_a_copy_continues_with_equal_samples() -> None:
    with closing(ring()) as env:
        env.external.spawn(*place_on(env, 0), speed=5.0, observes=True)
        advance(env)
        advance(env, 5, external_0=[0.1, 0.0])
        with closing(copy.deepcopy(env)) as other:
            for _ in range(5):
                here, there = advance(env), advance(other)
                assert list(here[0]) == list(there[0]) == ["car_0", "external_0"]
                for name in RIG:
                    one, two = (found[0]["external_0"][name] for found in (here, there))
                    assert one.tobytes() == two.tobytes()


def test_a_reset_removes_observing_vehicles() -> None:
    with closing(ring()) as env:
        env.external.spawn(*place_on(env, 0), observes=True)
        advance(env)
        observations, _ = env.reset(seed=1)
        assert list(observations) == env.agents == ["car_0"]


# PettingZoo's test warns about agents that never enter, and most slots stay unused.
@pytest.mark.filterwarnings("ignore:No agents present but not all possible_agents")
def test_observing_vehicles_conform_to_the_api_of_pettingzoo() -> None:
    with closing(ring()) as env:
        parallel_api_test(env, num_cycles=20)


@pytest.mark.parametrize(
    ("overrides", "match"),
    [
        ({"population.external": 0}, r"needs population\.external above 0"),
        ({"rig": {}}, "needs sensors under rig"),
        ({"clock.ctrl_dt_s": 0.1}, r"clock\.ctrl_dt_s.*must be clock\.sim_dt_s"),
    ],
)
def test_worlds_that_cannot_have_observing_vehicles_are_refused(
    overrides: dict[str, Any], match: str
) -> None:
    with pytest.raises(ConfigError, match=match):
        ring(overrides=overrides)


def test_an_observing_vehicle_needs_the_key_external_agents() -> None:
    with closing(ring(overrides={"population.external_agents": False})) as env:
        with pytest.raises(ConfigError, match=r"set population\.external_agents = true"):
            env.external.spawn(*place_on(env, 0), observes=True)
        with pytest.raises(ActionError, match="no agent 'external_0'"):
            env.frames("external_0")
        assert env.possible_agents == ["car_0"]
