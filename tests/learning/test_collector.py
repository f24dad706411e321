"""What is collected of worlds, for a critic that sees an agent and for one that sees the world."""

from __future__ import annotations

import pytest
import torch

from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.learning.collector import Collector
from cavmarl.policies.networks import ActorCritic, NetworkConfig

STEPS, HORIZON = 60, 25


def make_worlds(mode: str) -> CavVectorEnv:
    return make_vec(
        "merge", num_envs=3, agents=3, background=0, max_cycles=HORIZON, autoreset_mode=mode
    )


def make_collector(vec: CavVectorEnv, state_size: int) -> Collector:
    torch.manual_seed(0)
    config = NetworkConfig(
        "merge",
        vec.single_observation_space.shape[0],
        vec.config.sensors,
        vec.config.action,
        (8,),
        state_size=state_size,
    )
    return Collector(vec, ActorCritic(config, (2.0, 2.0)), STEPS, seed=0)


@pytest.mark.parametrize("central", [False, True])
def test_what_is_collected_is_cut_at_ends_and_at_the_horizon(central: bool) -> None:
    vec = make_worlds("NextStep" if central else "SameStep")
    batch = make_collector(vec, vec.state_size if central else 0).collect(with_suggested=False)
    boundary = batch.acted & ~batch.goes_on
    bootstrapped = boundary & (batch.next_values != 0.0)
    assert bootstrapped[HORIZON - 1].any()
    assert not bootstrapped[: HORIZON - 1].any()
    ended = boundary & ~bootstrapped
    assert ended.any()
    assert not (batch.goes_on & ~batch.acted).any()
    # Where the vehicle goes on, the next decision is the same vehicle's.
    assert batch.acted[1:][batch.goes_on[:-1]].all()


def test_values_are_of_the_state_that_the_world_was_in() -> None:
    vec = make_worlds("NextStep")
    collector = make_collector(vec, vec.state_size)
    first = torch.from_numpy(vec.state())
    batch = collector.collect(with_suggested=False)
    assert torch.equal(batch.states[0], first)
    for step, world, agent in batch.acted.nonzero()[::7].tolist():
        seen, state = batch.observations[step, world, agent], batch.states[step, world]
        value = collector.network.value(seen[None], state[None]).item()
        assert batch.values[step, world, agent].item() == pytest.approx(value, abs=1e-5)
    # A world that the horizon has cut is judged by its last state, not by its next episode's.
    step, world, agent = (batch.acted & ~batch.goes_on).nonzero()[-1].tolist()
    cut = batch.next_values[:HORIZON] != 0.0
    step, world, agent = (cut & ~batch.goes_on[:HORIZON]).nonzero()[0].tolist()
    assert step == HORIZON - 1
    last, state = batch.observations[step + 1, world, agent], batch.states[step + 1, world]
    value = collector.network.value(last[None], state[None]).item()
    assert batch.next_values[step, world, agent].item() == pytest.approx(value, abs=1e-5)


def test_the_clock_accounts_for_all_time() -> None:
    collector = make_collector(make_worlds("SameStep"), 0)
    collector.clock.take()
    collector.collect(with_suggested=True)
    spent_s = collector.clock.take()
    assert spent_s["learning"] == 0.0
    assert all(spent_s[phase] > 0.0 for phase in ("simulation", "transfer", "inference"))
    assert sum(collector.clock.take().values()) == 0.0
