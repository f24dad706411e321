"""Agents that control signals: observations, actions, rewards and equality of divided worlds."""

from __future__ import annotations

import hashlib
import os
import signal
import warnings
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl import ActionError, CavEnv, CavVectorEnv, ConfigError, make_vec, parallel_env
from cavmarl.adapters.gymnasium_env import CavEgoEnv
from cavmarl.adapters.gymnasium_rows import CavAgentRows
from cavmarl.config.signals import SIGNAL_TERMS
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import PolicyError
from cavmarl.cosim.carla.carla_server import serve
from cavmarl.cosim.carla.hosted_world import LoadedWorlds
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.driving.kernels.junctions.signal_timing import time_to_change
from cavmarl.policies.loading import load_policy
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.signals.controllers import make_controller
from cavmarl.signals.kernels.green_choices import GREEN, REFUSED, SINCE
from cavmarl.signals.kernels.lane_counts import STANDING, STOOD_TICKS, VEHICLES
from tests.support.signal_worlds import common_of_worlds

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test

TICKS = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0}
ALL = {"signals.agents": "all", **TICKS}


def world(env: str = "grid4x4", **more: Any) -> CavEnv:
    overrides = ALL | {f"signals.{name}": value for name, value in more.items()}
    return parallel_env(env, agents=2, background=60, seed=3, overrides=overrides)


def letters(env: CavEnv, s: int = 0) -> str:
    """Return the letters that the s-th signal with an agent shows."""
    row = env.signals.table.arrays.row[s]
    phase = env.network.phases[env.simulation.signal_phases(0)[row]]
    start, count = phase["first_state"], env.network.signals["num_links"][row]
    return "".join(SIGNAL_STATES[code] for code in env.network.phase_states[start : start + count])


def choose(env: CavEnv, choices: Any) -> dict[str, Any]:
    """Return the suggested actions for vehicles, and `choices` for each signal."""
    actions = env.suggest_actions()
    return actions | dict.fromkeys(env.signals.agents, choices)


# Sequence of phases


def test_yellow_and_all_red_come_between_two_greens() -> None:
    with closing(world(yellow_s=3.0, all_red_s=1.0, min_green_s=4.0, decide_s=2.0)) as env:
        env.reset()
        shown = []
        first, second = ("".join(SIGNAL_STATES[c] for c in g) for g in env.signals.table.greens[0])
        for _ in range(16):
            shown.append(letters(env))
            env.step(choose(env, 1))
        yellow = "".join(
            "y" if old in "gG" and new == "r" else old
            for old, new in zip(first, second, strict=True)
        )
        # The first green is shown at once, but its minimum of 4 s begins after 3 s + 1 s.
        assert shown[:9] == [first] * 9
        assert shown[9:11] == [yellow] * 2
        assert shown[11] == "r" * len(first)
        assert shown[12:] == [second] * 4


def test_a_green_lasts_at_least_its_minimum_and_at_most_its_maximum() -> None:
    with closing(world(min_green_s=6.0, max_green_s=10.0, decide_s=2.0, yellow_s=2.0)) as env:
        env.reset()
        lasted, since = [], 0
        for step in range(60):
            states = env.worlds.arrays.signal_states[0, 0].copy()
            env.step(choose(env, int(states[GREEN])))  # try to keep the green
            after = env.worlds.arrays.signal_states[0, 0]
            if after[SINCE] != states[SINCE]:
                lasted.append(step - since - 2)
                since = step
        assert lasted[0] == 10
        assert set(lasted) == {10}
        assert env.worlds.arrays.signal_states[0, 0, REFUSED] == len(lasted)


def test_forbidden_choices_are_counted_or_raise_an_error() -> None:
    with closing(world(min_green_s=8.0)) as env:
        _, infos = env.reset()
        agent = env.signals.agents[0]
        assert infos[agent]["action_mask"].tolist() == [1, 0]
        *_, infos = env.step(choose(env, 1))
        assert infos[agent]["refused"] == 1
        assert infos[agent]["green"] == 0
        assert infos[agent]["decides"] == 0
    with closing(world(min_green_s=8.0, forbidden="error")) as env:
        env.reset()
        with pytest.raises(ActionError, match=r"signal_A0: the action 1 is not allowed now; cho"):
            env.step(choose(env, 1))
        env.step(choose(env, 0))


def test_the_action_next_selects_the_next_green() -> None:
    with closing(world(action="keep_or_next", min_green_s=0.0, decide_s=5.0)) as env:
        env.reset()
        assert env.action_space(env.signals.agents[0]) == spaces.Discrete(2)
        greens = []
        for step in range(21):
            env.step(choose(env, 1 if step % 10 == 0 else 0))
            greens.append(int(env.worlds.arrays.signal_states[0, 0, GREEN]))
        # The choice of step 0 is refused, because the first green has not begun.
        assert greens[0] == 0
        assert greens[10] == 1
        assert greens[20] == 0


def test_signals_without_an_agent_keep_their_programs() -> None:
    def run(agents: Any) -> list[list[int]]:
        env = parallel_env(
            "grid4x4", agents=0, background=0, overrides=ALL | {"signals.agents": agents}
        )
        with closing(env):
            env.reset(seed=0)
            kept = []
            for _ in range(40):
                env.step(dict.fromkeys(env.signals.agents, 1))
                kept.append([int(k) for k in env.simulation.signal_phases(0)[2:]])
            return kept

    one, two = run(["A0"]), run(["A0", "A1"])
    assert one == two
    assert len(set(map(tuple, one))) > 1


# Observations and rewards


def expected_counts(
    env: CavEnv, standing_times: dict[int, tuple[int, int]]
) -> dict[str, NDArray[np.float64]]:
    """Return the expected counts of each lane.

    Args:
        env: the world.
        standing_times: (lane, standing ticks) of each vehicle.
    """
    found: dict[str, NDArray[np.float64]] = defaultdict(lambda: np.zeros(4))
    speed_mps = env.network.lanes["speed_mps"]
    for row in env.simulation.vehicles(0):
        lane = env.network.lane_ids[row["lane"]]
        standing = abs(row["speed"]) < 0.1
        lost = 1.0 - abs(row["speed"]) / (speed_mps[row["lane"]] * row["speed_factor"])
        found[lane] += [1, standing, standing_times[int(row["id"])][1], lost]
    return found


def test_observations_and_rewards_equal_a_computation_from_all_vehicles() -> None:
    weights = {"diff_wait": 1.0, "average_speed": 0.5, "queue": 0.25, "pressure": 0.125}
    weights |= {"delay": 0.1, "wait": 0.2}
    ticks = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 0.2}
    overrides = ALL | ticks | {"signals.terms": weights, "signals.decide_s": 1.0}
    env = parallel_env("grid4x4", agents=2, background=150, seed=3, overrides=overrides)
    with closing(env):
        env.reset()
        table, arrays = env.signals.table, env.worlds.arrays
        standing_times: dict[int, tuple[int, int]] = {}
        waited_before = np.zeros(len(table.ids))
        waits = 0
        rewards: dict[str, float] = {}
        for step in range(151):
            rows = env.simulation.vehicles(0)
            old, standing_times = standing_times, {}
            for number, lane, speed in zip(rows["id"], rows["lane"], rows["speed"], strict=True):
                before = old.get(int(number), (-1, 0))
                ticks_before = before[1] if before[0] == lane else 0
                standing_times[int(number)] = (int(lane), ticks_before + (abs(speed) < 0.1))
            if step % 5 == 0:
                counts = expected_counts(env, standing_times)
                for k, lane_id in enumerate(table.lanes):
                    columns = [VEHICLES, STANDING, STOOD_TICKS]
                    assert (
                        arrays.signal_counts[0, k, columns].tolist() == counts[lane_id][:3].tolist()
                    )
                for s, agent in enumerate(env.signals.agents):
                    incoming = [k for k in table.arrays.incoming[s].tolist() if k >= 0]
                    outgoing = [k for k in table.arrays.outgoing[s].tolist() if k >= 0]
                    names = [table.lanes[k] for k in incoming]
                    seen = arrays.signal_observations[0, s]
                    greens = len(table.greens[s])
                    for k, (name, lane) in enumerate(zip(names, incoming, strict=True)):
                        room = table.arrays.length_m[lane] / (2.5 + 5.0)
                        np.testing.assert_allclose(
                            seen[[greens + 1 + k, greens + 1 + len(names) + k]],
                            np.minimum(1.0, counts[name][:2] / room),
                            rtol=1e-6,
                        )
                    if step == 0:
                        continue
                    sums = np.sum([counts[name] for name in names], axis=0)
                    vehicles, standing, waited, lost = sums
                    waits += waited > 0
                    beyond = sum(counts[table.lanes[k]][0] for k in outgoing)
                    terms = dict(zip(weights, arrays.signal_terms[0, s].tolist(), strict=True))
                    assert terms["queue"] == -standing
                    assert terms["pressure"] == beyond - vehicles
                    wait_s = 0.2 * waited
                    assert terms["wait"] == pytest.approx(-wait_s / 100.0)
                    assert terms["delay"] == pytest.approx(-lost, abs=1e-4)
                    assert terms["diff_wait"] == pytest.approx(
                        (waited_before[s] - wait_s) / 100.0, abs=1e-6
                    )
                    assert 0.0 <= terms["average_speed"] <= 1.5
                    waited_before[s] = wait_s
                    total = sum(weights[name] * terms[name] for name in weights)
                    assert rewards[agent] == pytest.approx(total, rel=1e-5, abs=1e-6)
            else:
                assert not arrays.signal_rewards.any()
            _, rewards, *_ = env.step(env.suggest_actions())
        assert waits > 100


# The API


def test_an_environment_with_signal_agents_passes_pettingzoos_test() -> None:
    # In open mode, PettingZoo's test warns of agents that never entered.
    overrides = ALL | {"population.mode": "closed"}
    env = parallel_env("grid4x4", agents=2, background=60, overrides=overrides)
    with closing(env):
        parallel_api_test(env, num_cycles=30)
        observations, infos = env.reset(seed=1)
        for agent in env.signals.agents:
            assert env.observation_space(agent).contains(observations[agent])
            assert infos[agent]["decides"] == 1
        assert env.agents[-1] == "signal_D3"


@pytest.mark.parametrize("mode", ["closed", "open", "respawn"])
@pytest.mark.parametrize("agents", [0, 2])
def test_dicts_and_arrays_have_the_same_trajectories(mode: str, agents: int) -> None:
    keys = ALL | {"population.mode": mode, "population.budget": 4, "horizon_s": 40.0}
    settings: dict[str, Any] = {"agents": agents, "background": 30, "overrides": keys}
    env = parallel_env("town", **settings)
    vec = make_vec("town", num_envs=1, autoreset_mode="NextStep", **settings)
    with closing(env), closing(vec):
        signals, rng = vec.signals, np.random.default_rng(0)
        seen, infos = vec.reset(seed=2)
        observations, told = env.reset(seed=2)
        rewards: dict[str, float] = {}
        truncations: dict[str, bool] = {}
        steps = 0
        while True:
            for s, agent in enumerate(signals.agents):
                size, count = signals.table.features[s], signals.num_choices[s]
                assert observations[agent].tolist() == seen["signals"][0, s, :size].tolist()
                assert not seen["signals"][0, s, size:].any()
                mask = infos["signal_mask"][0, s].tolist()
                assert told[agent]["action_mask"].tolist() == mask[:count]
                assert not any(mask[count:])
                assert told[agent]["decides"] == infos["signal_decides"][0]
                terms = [told[agent][name] for name in SIGNAL_TERMS]
                assert terms == infos["signal_terms"][0, s].tolist()
            for k, agent in enumerate(vec.possible_agents):
                if agent in observations:
                    assert observations[agent].tolist() == seen["vehicles"][0, k].tolist()
            assert env.state_hash() == vec.state_hash()
            if not env.agents:
                break
            actions: dict[str, Any] = {
                "vehicles": vec.suggest_actions()["vehicles"],
                "signals": rng.integers(0, signals.num_choices)[None],
            }
            acting = dict(zip(vec.possible_agents, actions["vehicles"][0], strict=True))
            acting |= zip(signals.agents, actions["signals"][0], strict=True)
            observations, rewards, _, truncations, told = env.step(
                {agent: acting[agent] for agent in env.agents}
            )
            seen, paid, _, cut, infos = vec.step(actions)
            steps += 1
            for s, agent in enumerate(signals.agents):
                assert rewards[agent] == paid["signals"][0, s]
                assert truncations[agent] == cut["signals"][0, s]
            for k, agent in enumerate(vec.possible_agents):
                if agent in rewards:
                    assert rewards[agent] == paid["vehicles"][0, k]
        assert steps == 40
        assert infos["signal_refused"].any()


def test_signal_agents_are_truncated_at_the_horizon_and_never_terminated() -> None:
    env = parallel_env("grid4x4", agents=1, background=5, overrides=ALL | {"horizon_s": 9.0})
    with closing(env):
        env.reset(seed=0)
        steps = 0
        while env.agents:
            _, _, terminations, truncations, _ = env.step(env.suggest_actions())
            steps += 1
            for agent in env.signals.agents:
                assert not terminations[agent]
                assert truncations[agent] == (steps == 9)
        assert steps == 9


def test_a_world_can_have_only_signal_agents() -> None:
    vec = make_vec("grid4x4", num_envs=2, agents=0, background=40, overrides=ALL)
    with closing(vec):
        observations, infos = vec.reset(seed=0)
        assert isinstance(vec.observation_space, spaces.Dict)
        assert vec.observation_space["signals"].contains(observations["signals"])
        assert infos["signal_decides"].all()
        choices = np.zeros((2, 16), dtype=np.int64)
        observations, rewards, _, _, infos = vec.step({"signals": choices})
        assert rewards["signals"].shape == (2, 16)
        assert not infos["signal_decides"].any()


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((1, 2, 2)), r"must be a dict with the keys 'vehicles' and 'signals'"),
        ({"signals": np.zeros((1, 16), int)}, "actions lack vehicles"),
        ({"vehicles": None}, "actions lack signals"),
        (
            {"vehicles": None, "signals": np.zeros((1, 15), int)},
            r"shape \(1, 15\): must be",
        ),
        ({"vehicles": None, "signals": np.zeros((1, 16))}, "dtype float64: pass whole numbers"),
        ({"vehicles": None, "signals": np.full((1, 16), 2)}, "signal_A0: the action is 2, must be"),
        ({"vehicles": None, "signals": np.full((1, 16), -1)}, "signal_A0: the action is -1, must"),
    ],
)
def test_an_invalid_choice_raises_an_error_and_changes_nothing(actions: Any, message: str) -> None:
    vec = make_vec("grid4x4", num_envs=1, agents=2, background=5, overrides=ALL)
    with closing(vec):
        vec.reset(seed=0)
        before = vec.state_hash(0)
        if isinstance(actions, dict) and "vehicles" in actions:
            actions["vehicles"] = vec.suggest_actions()["vehicles"]
        with pytest.raises(ActionError, match=message):
            vec.step(actions)
        assert vec.state_hash(0) == before


def test_a_missing_choice_is_an_error_only_when_signals_decide() -> None:
    with closing(world()) as env:
        env.reset()
        cars = {agent: value for agent, value in env.suggest_actions().items() if "car" in agent}
        with pytest.raises(ActionError, match=r"no action for signal_A0, .*'decides'"):
            env.step(cars)
        env.step(choose(env, 0))
        env.step(cars)  # signals do not decide now


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"signals.agents": ["A9"]}, "no signal 'A9'; the map has A0, A1"),
        ({"signals.agents": "some"}, "must be none, all, or a list of ids"),
        ({"signals.agents": ["A0", "A0"]}, "names a signal twice"),
        ({"signals.decide_s": 0.7}, r"whole number of steps of clock.ctrl_dt_s = 1; try 1"),
        ({"signals.yellow_s": 0.3}, r"whole number of ticks of clock.sim_dt_s = 0.2; try 0.2"),
        ({"signals.max_green_s": 3.0}, r"must be 0, or at least signals.min_green_s = 5"),
        ({"signals.terms": {"speed": 1.0}}, "no such term; must be one of diff_wait"),
        (
            {"signals.range_m": 50.0, "signals.sensing": "camera"},
            "must be 0 with signals.sensing = camera",
        ),
    ],
)
def test_invalid_settings_are_refused_with_the_reason(
    overrides: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        make_vec("grid4x4", agents=1, background=5, overrides=ALL | overrides)


def test_signals_with_one_green_cannot_have_agents() -> None:
    with pytest.raises(ConfigError, match="no signal of this map has 2 to 64 greens"):
        make_vec("merge", agents=1, overrides=ALL)
    with pytest.raises(ConfigError, match=r"signals\.agents = none: set it"):
        _ = make_vec("merge", agents=1).signals


# Exactness


SENSING: dict[str, dict[str, Any]] = {
    "truth": {},
    "loops": {"signals.sensing": "loops", "signals.loop_upstream_m": 40.0},
    "camera": {
        "signals.sensing": "camera",
        "signals.camera_range_m": 120.0,
        "signals.camera_height_m": 4.0,
        "signals.camera_misses": 0.2,
        "population.types": ["car", "truck"],
    },
    "v2x": {
        "signals.sensing": "v2x",
        "v2x.enabled": True,
        "v2x.equipped": 0.6,
        "v2x.cam.rate_hz": 5.0,
        "v2x.denm.rate_hz": 5.0,
        "v2x.roadside.signals": ["all"],
        "v2x.roadside.rate_hz": 5.0,
        "v2x.channel.range_m": 150.0,
        "v2x.channel.loss": 0.3,
        "v2x.channel.latency_ticks": 1,
        "v2x.inbox.objects": 32,
    },
}


def hashes(
    sensing: str = "truth", kill_at: tuple[int, ...] = (), num_envs: int = 2, **more: Any
) -> list[str]:
    """Run worlds; return the hashes of their states and of the results of signal agents."""
    overrides = ALL | SENSING[sensing]
    overrides |= {"horizon_s": 30.0, "sensors.signal.timing": True, "signals.max_green_s": 10.0}
    vec: CavVectorEnv = make_vec(
        "grid4x4", num_envs=num_envs, agents=4, background=60, overrides=overrides, **more
    )
    with closing(vec):
        vec.reset(seed=1)
        rng, given = np.random.default_rng(0), hashlib.sha256()
        for step in range(45):  # one and a half episodes
            if step in kill_at:
                os.kill(vec.worlds.worker_pids[1], signal.SIGKILL)
            actions = vec.suggest_actions()
            actions["signals"] = rng.integers(0, 2, actions["signals"].shape)
            observations, rewards, _, truncations, infos = vec.step(actions)
            for array in (
                observations["signals"],
                observations["vehicles"],
                rewards["signals"],
                truncations["signals"],
                infos["signal_mask"],
                infos["signal_terms"],
                infos["signal_refused"],
                infos["final_observations"]["signals"],
                vec.signals.view.counts,
                vec.signals.view.loops,
            ):
                given.update(np.ascontiguousarray(array).tobytes())
        assert infos["signal_refused"].any()
        return [*(vec.state_hash(w) for w in range(num_envs)), given.hexdigest()]


@pytest.fixture(scope="module", params=SENSING)
def sensing(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def undivided(sensing: str) -> list[str]:
    return hashes(sensing)


@pytest.fixture(scope="module")
def undivided_world(sensing: str) -> list[str]:
    return hashes(sensing, num_envs=1)


@pytest.mark.parametrize("zones", [2, 4, 9])
def test_a_divided_world_equals_the_undivided_one(
    zones: int, sensing: str, undivided: list[str]
) -> None:
    assert hashes(sensing, zones=zones) == undivided


@pytest.mark.integration
def test_results_on_workers_equal_the_undivided_ones_when_a_worker_is_killed(
    sensing: str, undivided: list[str], undivided_world: list[str]
) -> None:
    # Workers share the zones of a single world, or each worker runs whole worlds.
    assert hashes(sensing, num_envs=1, zones=4, workers=2, kill_at=(7, 22)) == undivided_world
    assert hashes(sensing, workers=2, kill_at=(33,)) == undivided


@pytest.mark.integration
def test_results_over_nodes_equal_the_undivided_ones(
    sensing: str, undivided_world: list[str]
) -> None:
    assert hashes(sensing, num_envs=1, zones=3, nodes=2, kill_at=(24,)) == undivided_world


def test_a_reset_of_one_world_changes_no_other_world(sensing: str) -> None:
    overrides = ALL | SENSING[sensing]

    def second_world(is_first_reset: bool) -> list[Any]:
        vec = make_vec("grid4x4", num_envs=2, agents=2, background=60, overrides=overrides)
        with closing(vec):
            vec.reset(seed=1)
            found = []
            for step in range(30):
                if is_first_reset and step == 17:
                    vec.reset(options={"reset_mask": np.array([True, False])})
                vec.step(vec.suggest_actions())
                found.append(vec.worlds.arrays.signal_counts[1].tolist())
            assert vec.worlds.arrays.signal_counts[1, :, STOOD_TICKS].any()
            return [*found, vec.state_hash(1)]

    assert second_world(True) == second_world(False)


def test_a_saved_state_continues_with_other_zones(sensing: str) -> None:
    def steps(vec: CavVectorEnv, count: int) -> list[NDArray[Any]]:
        found: list[NDArray[Any]] = []
        for _ in range(count):
            observations, rewards, *_ = vec.step(vec.suggest_actions())
            found += [observations["signals"], rewards["signals"], vec.signals.view.counts.copy()]
        return found

    overrides = ALL | SENSING[sensing]
    first = make_vec("grid4x4", num_envs=2, agents=2, background=60, overrides=overrides)
    second = make_vec("grid4x4", num_envs=2, agents=2, background=60, zones=4, overrides=overrides)
    with closing(first), closing(second):
        first.reset(seed=4)
        steps(first, 17)
        saved = first.save_state()
        second.reset(seed=0)
        second.load_state(saved)
        for one, other in zip(steps(first, 23), steps(second, 23), strict=True):
            np.testing.assert_array_equal(one, other)
        assert first.state_hash(1) == second.state_hash(1)


# Controllers


def arrived(name: str) -> tuple[int, float]:
    """Return the number of arrivals in 350 s, and a measure of the number of stopped vehicles."""
    overrides = ALL | {
        "clock.ctrl_dt_s": 5.0,
        "horizon_s": 900.0,
        "population.mode": "open",
        "signals.max_green_s": 0.0,
    }
    vec = make_vec("grid4x4", num_envs=2, agents=0, background=150, overrides=overrides)
    controller = make_controller(name)
    with closing(vec):
        vec.reset(seed=1)
        stands = 0.0
        for _ in range(70):
            *_, infos = vec.step({"signals": controller.choose(vec.signals.view)})
            stands += vec.worlds.arrays.signal_counts[..., STANDING].sum() / 120.0
        assert not infos["signal_refused"].any()
        return sum(int(vec.traffic_stats(w)["arrived"]) for w in range(2)), stands


def test_more_vehicles_arrive_with_max_pressure_than_with_the_program() -> None:
    through, stands = arrived("program")
    assert through > 1000
    for name in ("longest_queue", "max_pressure"):
        better, fewer = arrived(name)
        assert better > 1.05 * through
        assert fewer < 0.8 * stands


def test_an_unknown_controller_is_refused() -> None:
    with pytest.raises(ConfigError, match="no signal controller 'greedy': must be one of prog"):
        make_controller("greedy")


def test_a_configured_controller_equals_choices_of_the_caller() -> None:
    overrides = ALL | {"signals.controller": "max_pressure", "horizon_s": 40.0}
    own = make_vec("grid4x4", agents=3, background=60, seed=2, overrides=ALL | {"horizon_s": 40.0})
    ready = make_vec("grid4x4", agents=3, background=60, seed=2, zones=4, overrides=overrides)
    controller = make_controller("max_pressure")
    with closing(own), closing(ready):
        own.reset()
        observations, infos = ready.reset()
        assert observations.shape[1] == ready.num_agents
        assert "signal_mask" not in infos
        for _ in range(35):
            actions = own.suggest_actions() | {"signals": controller.choose(own.signals.view)}
            actions["signals"] = np.maximum(actions["signals"], 0)
            own.step(actions)
            ready.step(ready.suggest_actions())
        assert own.state_hash() == ready.state_hash()


def test_policies_for_vehicles_refuse_worlds_with_signal_agents() -> None:
    vec = make_vec("grid4x4", agents=3, background=5, overrides=ALL)
    with closing(vec), pytest.raises(PolicyError, match=r"set signals\.controller to one of prog"):
        load_policy("idm", vec)


def test_policies_for_vehicles_can_be_loaded_beside_signal_agents() -> None:
    """They drive as in a world whose controller chooses the same greens."""
    program = {"signals.controller": "program"}
    vec = make_vec("grid4x4", agents=3, background=5, overrides=ALL)
    ready = make_vec("grid4x4", agents=3, background=5, overrides=ALL | program)
    with closing(vec), closing(ready):
        driver, alone = load_policy("idm", vec, beside_signals=True), load_policy("idm", ready)
        (seen, infos), (seen_alone, infos_alone) = vec.reset(seed=1), ready.reset(seed=1)
        for _ in range(60):
            vehicles = driver.act_batch(seen["vehicles"], infos["mask"])
            signals = vec.suggest_actions()["signals"]
            seen, *_, infos = vec.step({"vehicles": vehicles, "signals": signals})
            actions = alone.act_batch(seen_alone, infos_alone["mask"])
            seen_alone, *_, infos_alone = ready.step(actions)
        assert vec.state_hash() == ready.state_hash()
    env = parallel_env("grid4x4", agents=3, background=5, overrides=ALL)
    with closing(env):
        driver = load_policy("idm", env, beside_signals=True)
        observations, _ = env.reset(seed=1)
        actions = driver.act(observations)
        assert actions.keys() == {agent for agent in env.agents if agent.startswith("car_")}
        env.step(env.suggest_actions() | actions)


@pytest.mark.parametrize("adapter", [CavEgoEnv, CavAgentRows])
def test_adapters_for_vehicles_refuse_signal_agents(adapter: Any) -> None:
    with pytest.raises(ConfigError, match="this adapter has only vehicles as agents; set sig"):
        adapter("grid4x4", overrides=ALL)


def test_a_followed_world_refuses_signal_agents(tmp_path: Path) -> None:
    with (
        closing(world()) as env,
        pytest.raises(ConfigError, match="a followed world has only vehicles as agents"),
    ):
        FollowedWorld(env, tmp_path / "socket")


def test_a_world_for_clients_of_carla_refuses_signal_agents() -> None:
    message = "a world for CARLA's clients has only vehicles as agents"
    with closing(world()) as env, pytest.raises(ConfigError, match=message):
        serve(env)
    source = LoadedWorlds(WorldSpec.of("grid4x4", agents=1, overrides={"signals.agents": "all"}))
    with closing(source), pytest.raises(ConfigError, match=message):
        source.load("grid4x4", 0.05)


def test_calls_for_vehicles_refuse_the_names_of_signal_agents() -> None:
    with closing(world()) as env:
        env.reset()
        name = env.signals.agents[0]
        env.check_action(name, 1)
        for action, message in ((7, "is 7, must be from 0 to 1"), (0.5, "must be one whole num")):
            with pytest.raises(ActionError, match=message):
                env.check_action(name, action)
        with pytest.raises(ActionError, match="signals and roadside units have no sensors"):
            env.frames(name)
        with pytest.raises(ActionError, match=r"give an id of a vehicle from env\.agents"):
            env.declare_event(name, "obstacle")


@pytest.mark.parametrize("change", [(2.0, 1.0), (0.0, 0.0), (3.0, 0.0)])
def test_the_reported_time_to_a_change_is_a_lower_bound(change: tuple[float, float]) -> None:
    yellow_s, all_red_s = change
    times: dict[str, Any] = {"yellow_s": yellow_s, "all_red_s": all_red_s, "min_green_s": 4.0}
    with closing(world(decide_s=1.0, **times)) as env:
        env.reset()
        rng = np.random.default_rng(0)
        network, common = env.network, common_of_worlds(env.simulation)
        links = np.flatnonzero(network.links["signal"] == env.signals.table.arrays.row[0])
        shown: list[NDArray[np.int64]] = []
        expected = []
        for tick in range(70):
            phase = common.signal_phase[0]
            signals, places = network.links["signal"][links], network.links["signal_index"][links]
            starts = network.phases["first_state"][phase[signals]]
            shown.append(network.phase_states[starts + places].astype(np.int64))
            expected.append(
                [
                    time_to_change(
                        network.arrays, common.controllers[0], int(link), phase, float(tick), 0.2
                    )
                    for link in links
                ]
            )
            env.step(choose(env, int(rng.integers(2))))
        is_exact = 0
        for tick, (now, soonest) in enumerate(zip(shown, expected, strict=True)):
            for k in range(len(links)):
                later = [n for n in range(tick, 70) if shown[n][k] != now[k]]
                if later:
                    # The letter changed in the second before `later`.
                    assert soonest[k] <= later[0] - tick + 1e-9
                    is_exact += soonest[k] >= later[0] - tick - 1.0 - 1e-9
        assert is_exact > 100


def test_an_overridden_signal_state_takes_precedence_over_a_chosen_green() -> None:
    def run(**more: Any) -> list[str]:
        overrides = ALL | {"signals.overrides": 8, "horizon_s": 60.0}
        env = parallel_env("grid4x4", agents=2, background=60, overrides=overrides, **more)
        with closing(env):
            env.reset(seed=2)
            found = []
            for step in range(30):
                if step == 5:
                    env.signal_overrides.show("A0", 0, "r")
                if step == 20:
                    env.signal_overrides.release("A0")
                env.step(env.suggest_actions())
                assert (env.signal_overrides.letters("A0")[0] == "r") or not 5 <= step < 20
                found.append(env.signal_overrides.letters("A0"))
            assert len({letters[0] for letters in found}) > 1
            return [env.state_hash(), *found]

    assert run(zones=4) == run()
