"""Collected training data, with and without a central critic."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.networks.network_files import NetworkConfig
from cavmarl.policies.loading import load_policy
from tests.support.training import load_program

PPO = load_program("ppo")

STEPS, HORIZON = 60, 25


def make_worlds(mode: str) -> CavVectorEnv:
    return make_vec(
        "merge", num_envs=3, agents=3, background=0, max_cycles=HORIZON, autoreset_mode=mode
    )


def make_collector(
    vec: CavVectorEnv, state_size: int, *, residual: bool = False, imitate: str = ""
) -> Any:
    torch.manual_seed(0)
    config = NetworkConfig(
        "merge",
        vec.single_observation_space.shape[0] + 2 * residual,
        vec.config.sensors,
        vec.config.action,
        (8,),
        state_size=state_size,
        residual=residual,
    )
    args = PPO.Args(num_steps=STEPS, imitate=imitate)
    return PPO.Collector(vec, ActorCritic(config, (2.0, 2.0)), args, seed=0)


@pytest.mark.parametrize("central", [False, True])
def test_trajectories_end_with_trips_and_are_bootstrapped_at_the_horizon(central: bool) -> None:
    vec = make_worlds("NextStep" if central else "SameStep")
    batch = make_collector(vec, vec.state_size if central else 0).collect(with_suggested=False)
    boundary = batch.acted & ~batch.goes_on
    bootstrapped = boundary & (batch.next_values != 0.0)
    assert bootstrapped[HORIZON - 1].any()
    assert not bootstrapped[: HORIZON - 1].any()
    ended = boundary & ~bootstrapped
    assert ended.any()
    assert not (batch.goes_on & ~batch.acted).any()
    # If a trip goes on, the agent acts in the next step.
    assert batch.acted[1:][batch.goes_on[:-1]].all()


def test_the_central_critic_evaluates_the_state_of_each_step() -> None:
    vec = make_worlds("NextStep")
    collector = make_collector(vec, vec.state_size)
    first = torch.from_numpy(vec.state())
    batch = collector.collect(with_suggested=False)
    assert torch.equal(batch.states[0], first)
    for step, world, agent in batch.acted.nonzero()[::7].tolist():
        seen, state = batch.observations[step, world, agent], batch.states[step, world]
        value = collector.network.value(seen[None], state[None]).item()
        assert batch.values[step, world, agent].item() == pytest.approx(value, abs=1e-5)
    # At the horizon, the next value is of the last state, not of the next episode's first state.
    step, world, agent = (batch.acted & ~batch.goes_on).nonzero()[-1].tolist()
    cut = batch.next_values[:HORIZON] != 0.0
    step, world, agent = (cut & ~batch.goes_on[:HORIZON]).nonzero()[0].tolist()
    assert step == HORIZON - 1
    last, state = batch.observations[step + 1, world, agent], batch.states[step + 1, world]
    value = collector.network.value(last[None], state[None]).item()
    assert batch.next_values[step, world, agent].item() == pytest.approx(value, abs=1e-5)


def test_collecting_spends_time_in_all_phases_but_learning() -> None:
    collector = make_collector(make_worlds("SameStep"), 0)
    collector.collect(with_suggested=True)
    assert collector.times.spent_s["learning"] == 0.0
    assert all(collector.times.spent_s[phase] > 0.0 for phase in PPO.PHASES[:3])


def test_seats_of_opponents_are_not_trained() -> None:
    vec = make_worlds("SameStep")
    size = vec.single_observation_space.shape[0]
    config = NetworkConfig("merge", size, vec.config.sensors, vec.config.action, (8,))
    args = PPO.Args(num_steps=STEPS, opponents="idm,random_actions", opponent_share=0.3)
    collector = PPO.Collector(vec, ActorCritic(config), args, seed=0)
    batch = collector.collect(with_suggested=False)
    theirs = ~collector.opponents.absent
    assert 0 < int(theirs.sum()) < theirs.size
    assert not batch.acted[:, theirs].any()
    assert not batch.goes_on[:, theirs].any()
    assert batch.acted[:, ~theirs].float().mean() > 0.5


def test_a_resumed_collector_uses_the_saved_mask(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one, other = (make_collector(make_worlds("SameStep"), 0) for _ in range(2))
    last = one.vec.step
    masks: list[NDArray[np.bool_]] = []

    def step(actions: NDArray[Any]) -> Any:
        found = last(actions)
        masks.append(found[-1]["mask"].copy())
        return found

    monkeypatch.setattr(one.vec, "step", step)
    while not masks or masks[-1].all():
        one.collect(with_suggested=False)
    saved = one.save()
    given: list[NDArray[np.bool_]] = []
    monkeypatch.setattr(
        other.opponents, "act", lambda observations, mask, actions: given.append(mask.copy())
    )
    other.load(saved)
    other.collect(with_suggested=False)
    np.testing.assert_array_equal(given[0], masks[-1])


def test_with_end_at_red_the_value_after_a_red_light_violation_is_zero() -> None:
    found = {}
    for end_at_red in (False, True):
        vec = make_vec("grid4x4", num_envs=4, seed=0)
        size = vec.single_observation_space.shape[0]
        config = NetworkConfig("grid4x4", size, vec.config.sensors, vec.config.action, (8,))
        torch.manual_seed(0)
        args = PPO.Args(num_steps=100, end_at_red=end_at_red, opponents="")
        network = ActorCritic(config, (0.1, 0.01))
        with torch.no_grad():
            network.actor[-1].bias[0] = 0.6  # nearly full throttle
        found[end_at_red] = PPO.Collector(vec, network, args, seed=0).collect(False)
    calm, strict = found[False], found[True]
    assert torch.equal(calm.rewards, strict.rewards)
    ended = calm.goes_on & ~strict.goes_on
    assert ended.any()
    assert (strict.next_values[ended] == 0.0).all()


def test_a_residual_driver_observes_the_actions_of_the_built_in_driver() -> None:
    vec = make_worlds("SameStep")
    collector = make_collector(vec, 0, residual=True)
    proposed = torch.from_numpy(vec.suggest_actions().copy())
    batch = collector.collect(with_suggested=False)
    acted = batch.acted[0]
    assert torch.equal(batch.observations[0, ..., -2:][acted], proposed[acted])
    assert (batch.observations[1:, ..., -2:] != 0.0).any()
    assert (batch.acted & ~batch.goes_on & (batch.next_values != 0.0)).any()


@pytest.mark.parametrize("name", ["", "gentle"])
def test_suggested_actions_equal_those_of_the_imitated_driver(name: str) -> None:
    vec = make_vec("ring22", num_envs=2)
    collector = make_collector(vec, 0, imitate=name)
    teacher = load_policy(name or "idm", vec)
    seen, mask = vec.worlds.arrays.observations.copy(), np.ones((2, 1), dtype=bool)
    first = torch.from_numpy(teacher.act_batch(seen, mask))
    batch = collector.collect(with_suggested=True)
    assert torch.equal(batch.suggested[0], first.float())
    assert (batch.suggested[1:] != batch.suggested[0]).any()
