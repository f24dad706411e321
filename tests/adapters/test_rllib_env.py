"""Worlds as multi-agent environments of RLlib, in this process and in remote runners."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.env.parallel import parallel_env

ray = pytest.importorskip("ray", reason="needs the extra: rllib (make libraries)")
pytest.importorskip("ray.rllib", reason="needs the extra: rllib (make libraries)")

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray warns about its own code

MODES = ("closed", "open", "respawn")
HORIZON = 16


def config(mode: str = "open", kind: str = "flat") -> dict[str, Any]:
    return {
        "env": "merge",
        "agents": 3,
        "background": 3,
        "max_cycles": HORIZON,
        "overrides": {
            "population.mode": mode,
            "population.budget": 5,
            "observation.kind": kind,
            "action.out_of_range": "clip",
        },
    }


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield
    ray.shutdown()


@pytest.mark.parametrize("mode", MODES)
def test_rllib_gets_the_results_of_the_world(mode: str) -> None:
    """Compare with PettingZoo's environment.

    RLlib's environment may end earlier; the test then resets it.
    """
    from cavmarl.adapters.rllib_env import CavRllibEnv

    # In the mode "open" with one agent, an agent enters when the last agent's trip has ended.
    chosen = config(mode) | ({"agents": 1} if mode == "open" else {})
    env, twin = CavRllibEnv(chosen), parallel_env(**chosen)
    sampled = env.get_action_space("car_0")
    sampled.seed(0)
    handed_on = 0
    for seed in range(5):
        observations, infos = env.reset(seed=seed)
        assert observations.keys() == twin.reset(seed=seed)[0].keys()
        gone: set[str] = set()
        while twin.agents:
            assert all(env.get_observation_space(a).contains(o) for a, o in observations.items())
            actions = {agent: sampled.sample() for agent in env.agents}
            known = set(env.agents)
            observations, rewards, ended, cut, infos = env.step(actions)
            _, paid, theirs, their_cut, told = twin.step(actions)
            at_end = ended.pop("__all__"), cut.pop("__all__")
            gone |= {agent for agent in ended if ended[agent] or cut[agent]}
            assert any(at_end) == (known <= gone)
            assert at_end[1] == (any(at_end) and any(their_cut.values()))
            if any(at_end) and twin.agents:
                assert set(observations) == known
                entered, more_infos = env.reset()
                assert set(entered) == set(twin.agents)
                observations, infos = observations | entered, infos | more_infos
                absent = dict.fromkeys(entered, False)
                rewards, ended, cut = (
                    rewards | dict.fromkeys(entered, 0.0),
                    ended | absent,
                    cut | absent,
                )
                handed_on += 1
            assert (rewards, ended, cut, infos) == (paid, theirs, their_cut, told)
            assert env.agents == twin.agents
            assert not gone & set(env.agents)
    assert (handed_on > 0) == (mode == "open")


def test_the_horizon_truncates_and_does_not_terminate() -> None:
    from cavmarl.adapters.rllib_env import CavRllibEnv

    env = CavRllibEnv(config("closed"))
    env.reset(seed=0)
    brake = {agent: [-1.0, 0.0] for agent in env.agents}
    for _ in range(HORIZON):
        _, _, ended, cut, _ = env.step(brake)
    assert cut["__all__"]
    assert not ended["__all__"]


def train(flat: bool = True, **runners: Any) -> dict[str, Any]:
    """Run one update of PPO; return the results of its environment runners."""
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.connectors.env_to_module import FlattenObservations

    from cavmarl.adapters.rllib_env import CavRllibEnv

    if not flat:
        flatten = partial(FlattenObservations, multi_agent=True)
        runners["env_to_module_connector"] = lambda env, spaces=None, device=None: flatten()
    mode = runners.pop("mode", "open")
    algorithm = (
        PPOConfig()
        .environment(CavRllibEnv, env_config=config(mode, "flat" if flat else "dict"))
        .env_runners(rollout_fragment_length=64, **runners)
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, *_, **__: "shared")
        .training(train_batch_size_per_learner=128, minibatch_size=64, num_epochs=1)
        .learners(num_learners=0)
        .debugging(seed=0, log_level="ERROR")
        .build_algo()
    )
    found: dict[str, Any] = algorithm.train()["env_runners"]
    algorithm.stop()
    return found


@pytest.mark.usefixtures("cluster")
@pytest.mark.parametrize("mode", MODES)
def test_ppo_trains_in_every_population_mode(mode: str) -> None:
    found = train(mode=mode, num_env_runners=0)
    assert found["num_episodes"] > 0
    seen = set(found["agent_episode_returns_mean"])
    assert seen == {f"car_{k}" for k in range(5 if mode == "open" else 3)}


@pytest.mark.usefixtures("cluster")
def test_two_worlds_of_one_runner_train() -> None:
    assert train(num_env_runners=0, num_envs_per_env_runner=2)["num_episodes"] > 0


@pytest.mark.usefixtures("cluster")
def test_a_remote_runner_trains() -> None:
    assert train(num_env_runners=1)["num_episodes"] > 0


@pytest.mark.usefixtures("cluster")
def test_dict_observations_train_with_a_connector_that_flattens() -> None:
    assert train(flat=False, num_env_runners=0)["num_episodes"] > 0


def test_a_world_without_agents_is_refused() -> None:
    from cavmarl.adapters.rllib_env import CavRllibEnv

    with pytest.raises(ConfigError, match=r"population\.agents = 0"):
        CavRllibEnv({"env": "merge", "agents": 0})


# Agents of signals

TOWN = {"signals.agents": "all", "clock.ctrl_dt_s": 1.0, "signals.decide_s": 2.0, "horizon_s": 9.0}


def town(agents: int, mode: str) -> dict[str, Any]:
    """Return settings of a world whose signals differ in their numbers of lanes and greens."""
    keys = TOWN | {"population.mode": mode, "population.budget": 4}
    return {"env": "town", "agents": agents, "background": 20, "overrides": keys}


@pytest.mark.parametrize("agents", [0, 2])
@pytest.mark.parametrize("mode", MODES)
def test_signals_observe_and_act_only_at_their_decisions(mode: str, agents: int) -> None:
    """The results at decisions equal those of the world; between decisions, signals have none."""
    from cavmarl.adapters.rllib_env import CavRllibEnv, policy_of

    env, twin = CavRllibEnv(town(agents, mode)), parallel_env(**town(agents, mode))
    signals = twin.signals
    cars = [agent for agent in env.possible_agents if policy_of(agent) == "vehicles"]
    assert bool(cars) == bool(agents)
    assert env.possible_agents == [*cars, *signals.agents]
    action_space = env.get_action_space(signals.agents[0])
    assert action_space.n == max(twin.action_space(agent).n for agent in signals.agents)
    for agent in env.possible_agents:
        env.get_action_space(agent).seed(len(agent))
    observations, infos = env.reset(seed=3)
    theirs, told = twin.reset(seed=3)
    first, kept = observations, copy.deepcopy(observations)
    calls, beyond, decisions = 0, 0, 0
    while True:
        for agent, seen in observations.items():
            assert env.get_observation_space(agent).contains(seen)
            if agent in signals.agents:
                own = theirs[agent]
                size, num = len(own), len(told[agent]["action_mask"])
                assert seen["observations"][:size].tolist() == own.tolist()
                assert not seen["observations"][size:].any()
                assert seen["action_mask"][:num].tolist() == told[agent]["action_mask"].tolist()
                assert not seen["action_mask"][num:].any()
            else:
                assert seen.tolist() == theirs[agent].tolist()
            assert infos[agent].keys() == told[agent].keys()
        if not twin.agents:
            break
        acting = [agent for agent in env.agents if agent in observations]
        actions = {agent: env.get_action_space(agent).sample() for agent in acting}
        own_actions = dict(actions)
        for agent in set(acting) & set(signals.agents):
            decisions += 1
            if actions[agent] >= twin.action_space(agent).n:
                own_actions[agent] = told[agent]["green"]
                beyond += 1
        observations, rewards, ended, cut, infos = env.step(actions)
        calls += 1
        theirs, paid, over, left, told = twin.step(own_actions)
        decides = told[signals.agents[0]]["decides"]
        while not decides and twin.agents == list(signals.agents):
            more = twin.step({})
            theirs, paid, over, left, told = (
                old | new for old, new in zip((theirs, paid, over, left, told), more, strict=True)
            )
            decides = told[signals.agents[0]]["decides"]
        is_shown = decides or not twin.agents
        expected = {agent for agent in theirs if is_shown or agent not in signals.agents}
        assert observations.keys() == rewards.keys() == infos.keys() == expected
        assert ended.pop("__all__") is False
        assert cut.pop("__all__") == (not twin.agents)
        assert rewards == {agent: paid[agent] for agent in expected}
        assert ended == {agent: over[agent] for agent in expected}
        assert cut == {agent: left[agent] for agent in expected}
        assert env.agents == twin.agents
    for agent in signals.agents:  # later steps must not overwrite earlier observations
        np.testing.assert_equal(first[agent], kept[agent])
    assert beyond > 0
    assert decisions == 9 * 5  # each of 9 signals decides every 2 s of the 9 s
    if not agents:
        assert calls == 5
    elif mode == "respawn":  # vehicles act in each step
        assert calls == 9


@pytest.mark.usefixtures("cluster")
@pytest.mark.parametrize("agents", [0, 2])
def test_vehicles_and_signals_train_separate_policies(agents: int) -> None:
    """Signals use the masking module of RLlib, so they choose only greens that are allowed."""
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
    from ray.rllib.core.rl_module.rl_module import RLModuleSpec
    from ray.rllib.examples.rl_modules.classes.action_masking_rlm import (
        ActionMaskingTorchRLModule,
    )

    from cavmarl.adapters.rllib_env import CavRllibEnv, policy_of

    modules = {"signals": RLModuleSpec(module_class=ActionMaskingTorchRLModule)}
    if agents:
        modules["vehicles"] = RLModuleSpec()
    world = town(agents, "open")
    world["overrides"] |= {
        "action.out_of_range": "clip",
        "signals.forbidden": "error",
        "horizon_s": 40.0,
    }
    algorithm = (
        PPOConfig()
        # The check of environments is off, because it acts at random, without masks.
        .environment(CavRllibEnv, env_config=world, disable_env_checking=True)
        .env_runners(num_env_runners=0, rollout_fragment_length=64)
        .multi_agent(policies=set(modules), policy_mapping_fn=policy_of)
        .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=modules))
        .training(train_batch_size_per_learner=128, minibatch_size=64, num_epochs=1)
        .learners(num_learners=0)
        .debugging(seed=0, log_level="ERROR")
        .build_algo()
    )
    before = algorithm.get_weights()
    found = algorithm.train()
    after = algorithm.get_weights()
    algorithm.stop()
    assert found["env_runners"]["num_episodes"] > 0
    for policy in modules:
        changes = [(after[policy][name] != each).any() for name, each in before[policy].items()]
        assert any(changes), f"{policy} does not learn"
        assert np.isfinite(found["learners"][policy]["total_loss"])
