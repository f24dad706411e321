"""`CavEnv`: populations, ends of episodes, observations, actions and rewards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from cavmarl import TERMS, CavEnv, parallel_env
from cavmarl.sensors.observed import layout

ENDS = ("arrival", "collision", "off_road")


def make(env: str = "merge", mode: str = "closed", **arguments: Any) -> Any:
    """Make a small environment. Its type is Any, because observations may be arrays or dicts."""
    overrides: Mapping[str, Any] = arguments.pop("overrides", {})
    return parallel_env(
        env,
        **{"agents": 4, "background": 8, "seed": 0, **arguments},
        overrides={"population.mode": mode, **overrides},
    )


def wild(env: CavEnv, rng: np.random.Generator) -> dict[str, Any]:
    """Return full throttle and random steering, with which most vehicles soon end their trips."""
    return {agent: np.array([1.0, rng.uniform(-1.0, 1.0)]) for agent in env.agents}


# Populations


def test_a_closed_world_starts_with_all_agents_and_no_agent_enters_later() -> None:
    env = make("ring", "closed")
    observations, _ = env.reset()
    assert list(observations) == env.agents == env.possible_agents
    rng = np.random.default_rng(0)
    before = set(env.agents)
    while env.agents:
        _, _, terminations, truncations, _ = env.step(wild(env, rng))
        assert set(terminations) == before, (
            "agents that did not act get a result, or acting agents get none"
        )
        gone = {agent for agent in before if terminations[agent] or truncations[agent]}
        before -= gone
        assert set(env.agents) == before


def test_each_declared_agent_enters_at_most_once() -> None:
    env = make("merge", "open", agents=3, overrides={"population.budget": 9})
    assert len(env.possible_agents) == 9
    observations, infos = env.reset()
    seen = list(env.agents)
    gone: set[str] = set()
    vehicles: dict[str, int] = {}
    rng = np.random.default_rng(1)
    while env.agents:
        assert not gone & set(env.agents), "an agent that had left entered again"
        assert len(env.agents) <= 3
        before = set(env.agents)
        for agent in env.agents:
            assert vehicles.setdefault(agent, infos[agent]["vehicle_id"]) >= 0
        observations, rewards, terminations, truncations, infos = env.step(wild(env, rng))
        for agent in set(env.agents) - before:
            seen.append(agent)
            assert observations[agent].any(), "an entering agent gets no first observation"
            assert rewards[agent] == 0.0
            assert not terminations[agent]
            assert not truncations[agent]
        gone |= {agent for agent in before if terminations[agent] or truncations[agent]}
    assert sorted(seen) == env.possible_agents, "a declared agent did not enter"
    assert len(set(vehicles.values())) == 9


def test_an_empty_world_continues_until_the_next_agent_enters() -> None:
    env = make("merge", "open", agents=1, background=0, overrides={"population.budget": 3})
    env.reset()
    rng = np.random.default_rng(0)
    for agent in ("car_0", "car_1", "car_2"):
        terminations = {agent: False}
        while not terminations[agent]:
            assert env.agents == [agent]
            observations, rewards, terminations, _, infos = env.step(wild(env, rng))
        assert infos[agent]["vehicle_done"] == 1.0
        follower = set(observations) - {agent}
        assert follower == set(env.agents)
        assert all(rewards[other] == 0.0 and infos[other]["active"] for other in follower)
    assert not env.agents, "an agent enters beyond the budget"


def test_an_empty_world_waits_for_agents_at_most_until_the_horizon() -> None:
    # The ring is so full that no agent can enter after the only agent has left.
    env = make("ring", "open", agents=1, background=60, max_cycles=200)
    env.reset()
    rng = np.random.default_rng(0)
    while env.agents:
        env.step(wild(env, rng))
    assert env.simulation.ticks()[0] <= 200 * env.config.clock.ticks_per_step


def test_agents_remain_and_get_new_vehicles_in_respawn_mode() -> None:
    env = make("merge", "respawn")
    _, infos = env.reset()
    rng = np.random.default_rng(2)
    vehicle = {agent: infos[agent]["vehicle_id"] for agent in env.agents}
    waited, replaced = 0, 0
    for _ in range(300):
        needed = [agent for agent in env.agents if infos[agent]["active"]]
        actions = wild(env, rng)
        observations, rewards, terminations, truncations, infos = env.step(
            {agent: actions[agent] for agent in needed}
        )
        assert env.agents == env.possible_agents == list(observations)
        assert not any(terminations.values())
        assert not any(truncations.values())
        for agent, info in infos.items():
            ended = any(info[term] for term in ENDS)
            assert info["vehicle_done"] == ended
            assert not (info["vehicle_done"] and info["active"])
            if agent not in needed:
                waited += 1
                assert rewards[agent] == 0.0
                assert not any(info[term] for term in TERMS)
            if info["active"] and info["vehicle_id"] != vehicle[agent]:
                replaced += 1
                assert info["vehicle_id"] > vehicle[agent]
                vehicle[agent] = info["vehicle_id"]
            if info["vehicle_id"] < 0:
                assert not observations[agent].any()
    assert replaced > 5
    assert waited > 5


# The end of an episode


@pytest.mark.parametrize("mode", ["closed", "open", "respawn"])
def test_episodes_are_truncated_after_exactly_max_cycles_steps(mode: str) -> None:
    env = make("grid4x4", mode, max_cycles=7)
    assert env.max_cycles == 7
    env.reset()
    for step in range(1, 8):
        agents = list(env.agents)
        _, _, terminations, truncations, _ = env.step(env.suggest_actions())
        assert set(truncations.values()) == {step == 7}
        assert not any(terminations.values())
        assert list(truncations) == agents
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_trips_terminate_only_by_arrival_collision_or_leaving_the_road() -> None:
    seen = set()
    for driver in ("suggested", "straight", "wild"):
        env = make("ring", "closed", agents=6, background=12, max_cycles=800)
        env.reset(seed=1)
        rng = np.random.default_rng(0)
        while env.agents:
            actions = wild(env, rng) if driver == "wild" else env.suggest_actions()
            if driver == "straight":
                actions = {a: np.array([1.0, actions[a][1]], np.float32) for a in actions}
            agents = list(env.agents)
            _, _, terminations, _, infos = env.step(actions)
            for agent in agents:
                why = {term for term in ENDS if infos[agent][term]}
                assert terminations[agent] == bool(why)
                seen |= why
    assert seen == set(ENDS)


# Rewards and infos


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
@pytest.mark.parametrize("mode", ["closed", "respawn"])
def test_the_reward_is_the_weighted_sum_of_the_terms(mode: str, share: float) -> None:
    weights = {term: 0.5 - 0.3 * k for k, term in enumerate(TERMS)}
    env = make("ring", mode, overrides={"terms.weights": weights, "terms.team_share": share})
    _, infos = env.reset()
    rng = np.random.default_rng(3)
    paid = 0.0
    for _ in range(60):
        if not env.agents:
            break
        acting = [agent for agent in env.agents if infos[agent]["active"]]
        _, rewards, _, _, infos = env.step(wild(env, rng))
        own = {a: sum(weights[term] * infos[a][term] for term in TERMS) for a in acting}
        team = sum(own.values()) / max(len(own), 1)
        for agent in acting:
            expected = (1.0 - share) * own[agent] + share * team
            assert rewards[agent] == pytest.approx(expected, rel=1e-5, abs=1e-5)
            paid += abs(rewards[agent])
    assert paid > 0.0


def test_terms_without_a_weight_do_not_count() -> None:
    env = make("ring", overrides={"terms.weights": {"delay": 2.0}})
    env.reset()
    for _ in range(5):
        _, rewards, _, _, infos = env.step(env.suggest_actions())
        for agent, reward in rewards.items():
            assert reward == pytest.approx(2.0 * infos[agent]["delay"], rel=1e-6)


@pytest.mark.parametrize("mode", ["closed", "open", "respawn"])
def test_infos_have_constant_names_and_plain_numbers(mode: str) -> None:
    env = make("merge", mode)
    _, infos = env.reset()
    names = {*TERMS, "active", "vehicle_done", "vehicle_id"}
    rng = np.random.default_rng(0)
    for _ in range(80):
        for info in infos.values():
            assert info.keys() == names
            assert {type(value) for value in info.values()} <= {int, float}
        if env.agents:
            _, rewards, terminations, truncations, infos = env.step(wild(env, rng))
            assert {type(reward) for reward in rewards.values()} <= {float}
            ends = [*terminations.values(), *truncations.values()]
            assert {type(end) for end in ends} <= {bool}


# Observations and the state


@pytest.mark.parametrize("env_name", ["ring", "merge", "grid4x4", "town"])
def test_observations_stay_within_the_space(env_name: str) -> None:
    env = make(env_name, "respawn", overrides={"sensors.lidar.speeds": True})
    space = env.observation_space("car_0")
    assert space is env.observation_space("car_1")
    observations, _ = env.reset()
    rng = np.random.default_rng(0)
    for _ in range(150):
        for observation in observations.values():
            assert space.contains(observation), observation[np.abs(observation) > 1.0]
        observations, *_ = env.step(wild(env, rng))


def test_dict_observations_contain_the_slices_of_flat_observations() -> None:
    flat = make("grid4x4", "respawn")
    parts = make("grid4x4", "respawn", overrides={"observation.kind": "dict"})
    places = layout(flat.config.sensors)
    space = parts.observation_space("car_0")
    assert isinstance(space, spaces.Dict)
    assert set(space) == set(places)
    whole, _ = flat.reset()
    pieces, _ = parts.reset()
    for _ in range(40):
        for agent, observation in whole.items():
            assert space.contains(pieces[agent])
            joined = np.concatenate([pieces[agent][sensor] for sensor in places])
            np.testing.assert_array_equal(joined, observation)
        whole, *_ = flat.step(flat.suggest_actions())
        pieces, *_ = parts.step(parts.suggest_actions())


@pytest.mark.parametrize(
    ("key", "sensor"),
    [
        ("sensors.route.points", "route"),
        ("sensors.neighbors.count", "neighbors"),
        ("sensors.lidar.rays", "lidar"),
        ("sensors.lanes.range_m", "lanes"),
    ],
)
def test_other_sensors_do_not_change_if_a_sensor_is_switched_off(key: str, sensor: str) -> None:
    on = {"sensors.lidar.rays": 16}
    full, reduced = make("merge", overrides=on), make("merge", overrides={**on, key: 0})
    places = layout(full.config.sensors)
    assert sensor not in layout(reduced.config.sensors)
    whole, _ = full.reset()
    rest, _ = reduced.reset()
    for agent in full.agents:
        expected = np.delete(whole[agent], np.arange(places[sensor].start, places[sensor].stop))
        np.testing.assert_array_equal(rest[agent], expected)


def test_the_global_state_has_the_position_of_every_vehicle() -> None:
    env = make("grid4x4", "respawn")
    env.reset()
    for _ in range(50):
        env.step(env.suggest_actions())
    state = env.state().reshape(-1, 6)
    assert env.state_space.contains(env.state())
    vehicles = np.sort(env.simulation.vehicles(), order="id")
    present = state[:, 0] == 1.0
    assert np.count_nonzero(present) == len(vehicles) == env.traffic_stats()["running"]
    min_x, min_y, max_x, max_y = env.network.extent_m
    x = min_x + 0.5 * (state[present, 1] + 1.0) * (max_x - min_x)
    y = min_y + 0.5 * (state[present, 2] + 1.0) * (max_y - min_y)
    np.testing.assert_allclose(x, vehicles["x"], atol=0.01)
    np.testing.assert_allclose(y, vehicles["y"], atol=0.01)
    heading = np.arctan2(state[present, 4], state[present, 3])
    np.testing.assert_allclose(np.cos(heading - vehicles["heading"]), 1.0, atol=1e-5)
    np.testing.assert_allclose(state[present, 5] * 40.0, vehicles["speed"], atol=1e-4)


# Actions


@pytest.mark.parametrize("latency", [0, 1, 5, 16])
@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_an_action_has_its_first_effect_after_the_latency(latency: int, kind: str) -> None:
    overrides = {
        "clock.ctrl_dt_s": 0.05,
        "clock.control_latency_ticks": latency,
        "action.kind": kind,
    }
    calm, braking = (
        make("ring", agents=1, background=0, overrides=overrides, max_cycles=100) for _ in range(2)
    )
    for env in (calm, braking):
        env.reset()
    idle, brake = (np.zeros(2), np.array([-1.0, 0.0])) if kind == "continuous" else (1, 4)
    apart = []
    for step in range(25):
        calm.step({"car_0": idle})
        braking.step({"car_0": brake if step == 0 else idle})
        speeds = [float(env.simulation.vehicles()[0]["speed"]) for env in (calm, braking)]
        apart.append(speeds[0] != speeds[1])
    assert apart == [False] * latency + [True] * (25 - latency)


def test_continuous_actions_are_shares_of_the_configured_limits() -> None:
    env = make(
        "merge",
        agents=1,
        background=0,
        overrides={"action.acceleration_mps2": 2.0, "action.steering_rad": 0.1},
    )
    env.reset()
    before = float(env.simulation.vehicles()[0]["speed"])
    env.step({"car_0": np.array([0.5, -0.5])})
    vehicle = env.simulation.vehicles()[0]
    assert vehicle["speed"] - before == pytest.approx(0.5 * 2.0 * env.step_s)
    assert vehicle["steering"] == pytest.approx(-0.05)


@pytest.mark.parametrize(("action", "side"), [(0, "left"), (2, "right")])
def test_meta_actions_change_lanes(action: int, side: str) -> None:
    env = make("merge", agents=1, background=0, overrides={"action.kind": "discrete"})
    lanes = env.network.lanes
    for seed in range(100):
        env.reset(seed=seed)
        vehicle = env.simulation.vehicles()[0]
        target = lanes[vehicle["lane"]][side]
        if target >= 0 and vehicle["s"] < 100.0:
            break
    env.step({"car_0": action})
    assert env.simulation.vehicles()[0]["target_lane"] == target
    for _ in range(40):
        env.step({"car_0": 1})
    vehicle = env.simulation.vehicles()[0]
    assert vehicle["lane"] == target
    assert abs(vehicle["d"]) < 0.3


def test_a_change_to_a_missing_lane_has_no_effect() -> None:
    env = make("merge", agents=1, background=0, overrides={"action.kind": "discrete"})
    lanes = env.network.lanes
    for seed in range(100):
        env.reset(seed=seed)
        lane = env.simulation.vehicles()[0]["lane"]
        if lanes[lane]["left"] < 0:
            break
    env.step({"car_0": 0})
    assert env.simulation.vehicles()[0]["target_lane"] == lane


def test_the_actions_faster_and_slower_select_the_next_target_speed() -> None:
    speeds = [0.0, 4.0, 8.0, 12.0]
    overrides = {"action.kind": "discrete", "action.target_speeds_mps": speeds}
    env = make("ring", agents=1, background=0, overrides=overrides, max_cycles=1000)
    env.reset()
    faster, slower, idle = 3, 4, 1
    for _ in range(5):
        env.step({"car_0": slower})
    targets = []
    for action in (faster, faster, idle, faster, faster, slower):
        env.step({"car_0": action})
        targets.append(float(env.simulation.vehicles()[0]["target_speed"]))
    assert targets == [4.0, 8.0, 8.0, 12.0, 12.0, 8.0]
    for _ in range(60):
        env.step({"car_0": idle})
    assert env.simulation.vehicles()[0]["speed"] == pytest.approx(8.0, abs=0.1)


@pytest.mark.parametrize("env_name", ["ring", "merge", "grid4x4", "town"])
@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_suggested_actions_are_valid_and_lead_to_the_goals(env_name: str, kind: str) -> None:
    env = make(env_name, background=0, max_cycles=2500, overrides={"action.kind": kind})
    env.reset()
    fate = dict.fromkeys(env.agents, "cut")
    while env.agents:
        actions = env.suggest_actions()
        assert list(actions) == env.agents
        for agent, action in actions.items():
            assert env.action_space(agent).contains(action), action
        _, _, terminations, _, infos = env.step(actions)
        for agent, ended in terminations.items():
            if ended:
                fate[agent] = next(term for term in ENDS if infos[agent][term])
    assert fate == dict.fromkeys(fate, "arrival")


# Tools


def test_traffic_stats_count_events() -> None:
    env = make("merge", "respawn")
    env.reset()
    rng = np.random.default_rng(5)
    ended = dict.fromkeys(ENDS, 0)
    for _ in range(120):
        _, _, _, _, infos = env.step(wild(env, rng))
        for info in infos.values():
            for term in ENDS:
                ended[term] += int(info[term])
    stats = env.traffic_stats()
    assert stats["removed"] > 0
    assert stats["arrived"] >= ended["arrival"]
    assert stats["contacts"] >= ended["collision"]
    assert stats["departed"] == stats["running"] + stats["arrived"] + stats["removed"]
    vehicles = env.simulation.vehicles()
    assert stats["mean_speed_mps"] == pytest.approx(vehicles["speed"].mean())
    assert stats["actions_clipped"] == stats["actions_held"] == stats["actions_ignored"] == 0
    env.reset()
    assert env.traffic_stats()["arrived"] == 0
    assert env.traffic_stats()["departed"] == env.traffic_stats()["running"]


def test_tools_that_read_a_world_do_not_change_it() -> None:
    env = make("grid4x4", "respawn")
    env.reset()
    env.step(env.suggest_actions())
    before = env.state_hash()
    env.suggest_actions()
    env.state()
    env.traffic_stats()
    assert env.state_hash() == before
    assert env.step_s == env.config.clock.ctrl_dt_s
    env.step(env.suggest_actions())
    assert env.state_hash() != before
    env.close()
