"""Agents of speed limits: choices, observations, rewards, divided worlds and bad input."""

from __future__ import annotations

import hashlib
import os
import signal
import warnings
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl import ActionError, CavVectorEnv, ConfigError, make_vec, parallel_env
from cavmarl.adapters.gymnasium_env import CavEgoEnv
from cavmarl.config.limits import LIMIT_TERMS
from cavmarl.core.errors import PolicyError
from cavmarl.limits.kernels.limit_steps import DENSITY_SCALE, FLOW_SCALE, OF_SECTION, SPEED_SCALE
from cavmarl.policies.loading import load_policy

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test

STEP = {"clock.ctrl_dt_s": 5.0, "limits.decide_s": 5.0, "horizon_s": 200.0}
UNITS = {"limits.units": {"far": ["far"], "near": ["near"]}}
SPEEDS = {"limits.speeds_mps": [6.0, 12.0, 20.0, 40.0]}
KEYS: dict[str, Any] = {"limits.agents": "all", **STEP, **UNITS, **SPEEDS}


def vec_of(num_envs: int = 2, **more: Any) -> CavVectorEnv:
    overrides = KEYS | more.pop("overrides", {})
    return make_vec("lane_drop", num_envs=num_envs, overrides=overrides, **{"agents": 0, **more})


def test_vehicles_obey_the_chosen_speed_limit() -> None:
    with closing(vec_of(1)) as vec:
        vec.reset(seed=1)
        fastest = []
        for step in range(36):
            vec.step({"limits": np.array([[1 if step < 18 else 3, 3]])})
            rows = vec.simulation.vehicles(0).copy()
            lanes = vec.network.lanes["edge"][rows["lane"]]
            far = rows[lanes == vec.network.edge_ids.index("far")]
            fastest.append(far["speed"].max())
        assert max(fastest[10:18]) < 1.3 * 12.0
        assert fastest[-1] > 24.0  # 40 m/s exceeds the limit of the map, so the map's limit applies
        assert fastest[-1] < 1.35 * 27.78


def test_choices_too_far_from_the_present_limit_are_counted_or_refused() -> None:
    with closing(vec_of(1, overrides={"limits.most_change": 1, "limits.decide_s": 10.0})) as vec:
        _, infos = vec.reset(seed=1)
        assert infos["limit_mask"][0].tolist() == [[False, False, True, True]] * 2
        for choice, refused, mask in (
            (0, 1, [0, 0, 0, 1]),  # agents decide only in every second step
            (0, 1, [0, 0, 1, 1]),
            (2, 1, [0, 0, 1, 0]),
            (0, 1, [0, 1, 1, 1]),
        ):
            *_, infos = vec.step({"limits": np.full((1, 2), choice)})
            assert infos["limit_refused"].tolist() == [[refused] * 2]
            assert infos["limit_mask"][0, 0].tolist() == list(map(bool, mask))
    strict = {"limits.most_change": 1, "limits.forbidden": "error"}
    with closing(vec_of(1, overrides=strict)) as vec:
        vec.reset(seed=1)
        with pytest.raises(ActionError, match=r"limit_far: the action 0 is not allowed now; .*lim"):
            vec.step({"limits": np.zeros((1, 2), dtype=int)})


def test_observations_and_rewards_equal_values_computed_from_the_vehicles() -> None:
    keys = {"clock.ctrl_dt_s": 0.2, "limits.decide_s": 10.0, "horizon_s": 100.0}
    keys |= {"limits.terms": {"delay": 2.0, "change": 0.5}}
    with closing(vec_of(1, overrides=keys)) as vec:
        vec.reset(seed=2)
        network, sections = vec.network, list(vec.config.limits.sections)
        edge = [network.edge_ids.index(name) for name in sections]
        decision = []
        for step in range(450):
            choices = np.array([[2, 3 if step < 400 else 1]])
            observations, rewards, _, _, infos = vec.step({"limits": choices})
            rows = vec.simulation.vehicles(0).copy()
            decision.append((network.lanes["edge"][rows["lane"]], rows))
            if (step + 1) % 50:
                assert not rewards["limits"].any()
                continue
            lost = 0.0
            for m, row in enumerate(edge):
                inside = [rows[edges == row] for edges, rows in decision]
                count = sum(map(len, inside))
                speed = np.concatenate([each["speed"] for each in inside])
                lanes = network.lanes[network.lanes["edge"] == row]
                km = 1e-3 * lanes["length_m"].sum()
                mean = speed.mean() if count else SPEED_SCALE
                expected = [
                    count / 50 / km / DENSITY_SCALE,
                    count / 50 / km * mean * 3.6 / FLOW_SCALE if count else 0.0,
                    mean / SPEED_SCALE,
                    (speed < 0.1).mean() if count else 0.0,
                ]
                part = observations["limits"][0, 0, 4 + m * OF_SECTION :][:OF_SECTION]
                np.testing.assert_allclose(part, np.minimum(expected, 1.0), atol=2e-4)
                for each in inside:
                    desired = 27.78 * each["speed_factor"]
                    lost += np.maximum(1.0 - each["speed"] / desired, 0.0).sum()
            delay = -lost * 0.2 / 100.0
            changed = [-1.0 * (step == 49), -2.0 * (step == 449)]
            np.testing.assert_allclose(
                infos["limit_terms"][0], [[delay, changed[0]], [delay, changed[1]]], atol=1e-3
            )
            np.testing.assert_allclose(
                rewards["limits"][0], [2 * delay + 0.5 * each for each in changed], atol=3e-3
            )
            decision.clear()
        assert observations["limits"][0, :, :4].tolist() == [[0, 0, 1, 0], [0, 1, 0, 0]]


def test_the_parallel_environment_keeps_its_contract() -> None:
    env = parallel_env("lane_drop", agents=2, overrides=KEYS)
    with closing(env):
        assert env.possible_agents[-2:] == ["limit_far", "limit_near"]
        assert env.action_space("limit_far") == spaces.Discrete(4)
        parallel_api_test(env, num_cycles=30)
        _, infos = env.reset(seed=1)
        info = infos["limit_near"]
        assert info.keys() >= {"decides", "action_mask", "limit", "refused", *LIMIT_TERMS}
        assert info["limit"] == 3
        with pytest.raises(ActionError, match="limit_near: the action is 4, must be from 0 to 3"):
            env.step(env.suggest_actions() | {"limit_near": 4})


def hashes(
    kill_at: tuple[int, ...] = (), num_envs: int = 2, overrides: Any = None, **more: Any
) -> list[str]:
    """Return hashes of the states, and of all observations and rewards of the agents of limits."""
    keys = {"limits.decide_s": 10.0, "limits.most_change": 2, **(overrides or {})}
    vec = vec_of(num_envs, agents=3, overrides=keys, **more)
    with closing(vec):
        vec.reset(seed=1)
        rng, given = np.random.default_rng(0), hashlib.sha256()
        for step in range(55):  # one whole episode and a part of the next one
            if step in kill_at:
                os.kill(vec.worlds.worker_pids[1], signal.SIGKILL)
            actions = vec.suggest_actions()
            actions["limits"] = rng.integers(0, 4, actions["limits"].shape)
            observations, rewards, _, truncations, infos = vec.step(actions)
            for array in (
                observations["limits"],
                observations["vehicles"],
                rewards["limits"],
                truncations["limits"],
                infos["limit_mask"],
                infos["limit_terms"],
                infos["limit_refused"],
                infos["final_observations"]["limits"],
            ):
                given.update(np.ascontiguousarray(array).tobytes())
        assert infos["limit_refused"].any()
        return [*(vec.state_hash(w) for w in range(num_envs)), given.hexdigest()]


@pytest.fixture(scope="module")
def undivided() -> list[str]:
    return hashes()


@pytest.mark.parametrize("zones", [2, 3])
def test_a_divided_world_with_limit_agents_equals_the_undivided_world(
    zones: int, undivided: list[str]
) -> None:
    assert hashes(zones=zones) == undivided


@pytest.mark.integration
def test_a_world_with_limit_agents_is_the_same_on_workers_and_nodes(undivided: list[str]) -> None:
    assert hashes(workers=2, kill_at=(33,)) == undivided
    one = hashes(num_envs=1)
    assert hashes(num_envs=1, zones=3, workers=2, kill_at=(7,)) == one
    assert hashes(num_envs=1, zones=3, nodes=2, kill_at=(24,)) == one


def test_the_lower_limit_of_the_caller_and_the_agent_applies() -> None:
    with closing(vec_of(1, overrides={"map.changed_lanes": 3})) as vec:
        vec.reset(seed=1)
        edges = vec.network.lanes["edge"]
        far = edges == vec.network.edge_ids.index("far")

        def limits_mps() -> NDArray[Any]:
            found: NDArray[Any] = vec.simulation.worlds.lanes["speed_mps"][1, far]
            return found

        assert limits_mps().tolist() == [27.78] * 3
        vec.step({"limits": np.array([[2, 3]])})
        assert limits_mps().tolist() == [20.0] * 3
        vec.damage_road("far", speed_mps=15.0)
        vec.step({"limits": np.array([[2, 3]])})
        assert limits_mps().tolist() == [15.0] * 3
        vec.step({"limits": np.array([[0, 3]])})
        assert limits_mps().tolist() == [6.0] * 3
        vec.reset(seed=1)
        assert limits_mps().tolist() == [27.78] * 3


def test_a_saved_state_continues_with_other_zones() -> None:
    def steps(vec: CavVectorEnv, count: int) -> list[NDArray[Any]]:
        found: list[NDArray[Any]] = []
        for step in range(count):
            choices = np.full((2, 2), step % 4)
            observations, rewards, *_ = vec.step({"limits": choices})
            found += [observations["limits"], rewards["limits"]]
        return found

    first, second = vec_of(), vec_of(zones=2)
    with closing(first), closing(second):
        first.reset(seed=4)
        steps(first, 17)
        saved = first.save_state()
        second.reset(seed=0)
        second.load_state(saved)
        for one, other in zip(steps(first, 15), steps(second, 15), strict=True):
            np.testing.assert_array_equal(one, other)
        assert first.state_hash(1) == second.state_hash(1)


def test_a_controller_chooses_limits_if_only_vehicles_are_agents() -> None:
    keys = {"limits.controller": "feedback", "limits.wanted_per_km": 5.0}
    vec = vec_of(1, agents=2, overrides=keys)
    with closing(vec):
        vec.reset(seed=1)
        for _ in range(30):
            vec.step(vec.suggest_actions())
        assert (vec.limits.view.states[..., 1] < 3).all()
    with closing(vec_of(1, agents=2)) as vec, pytest.raises(PolicyError, match=r"limits\.agents"):
        load_policy("idm", vec)
    with pytest.raises(ConfigError, match=r"this adapter has only vehicles as agents; set limits"):
        CavEgoEnv("lane_drop", overrides=KEYS)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"limits.units": {}}, r"limits\.units = \{\}: must name a unit"),
        ({"limits.units": {"far": []}}, r"limits\.units\.far: names no edge"),
        ({"limits.units": {"far": ["nowhere"]}}, r"no edge 'nowhere' on the map; it has far"),
        ({"limits.sections": {"a": ["far"], "b": ["far"]}}, r"edge 'far' is already in 'a'"),
        ({"limits.agents": ["there"]}, r"limits\.agents: no unit 'there'; must be one of far, n"),
        ({"limits.agents": "some"}, r"limits\.agents = 'some': must be none, all"),
        ({"limits.speeds_mps": [20.0, 10.0]}, r"limits\.speeds_mps = .* ascending"),
        ({"limits.speeds_mps": [0.0, 10.0]}, r"limits\.speeds_mps = .* above 0"),
        ({"limits.decide_s": 7.0}, r"limits\.decide_s = 7\.0: must be a whole number of steps"),
        ({"limits.terms": {"joy": 1.0}}, r"limits\.terms = 'joy': no such term"),
        ({"limits.watched": "sky"}, r"limits\.watched = 'sky': must be one of far"),
    ],
)
def test_wrong_settings_have_clear_errors(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        vec_of(overrides=overrides)
