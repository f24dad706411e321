"""PPO's updates, compared with hand-computed values."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from cavmarl.config.action import ActionConfig
from cavmarl.config.sensors import SensorsConfig
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.networks.network_files import NetworkConfig
from tests.support.training import load_program

PPO = load_program("ppo")


def learner(**settings: Any) -> Any:
    """Create a learner that observes three numbers."""
    torch.manual_seed(0)
    network = ActorCritic(NetworkConfig("merge", 3, SensorsConfig(), ActionConfig(), (4,)))
    return PPO.Learner(network, PPO.Args(**settings))


@pytest.mark.parametrize(
    ("left", "weight"), [(1.0, 2.0), (0.875, 1.0), (0.8, 0.4), (0.75, 0.0), (0.3, 0.0)]
)
def test_the_weight_of_imitation_falls_to_zero_after_its_share_of_the_run(
    left: float, weight: float
) -> None:
    found = learner(imitation_weight=2.0, imitation_share=0.25)
    assert found.imitation_weight(left) == pytest.approx(weight)


def batch(rewards: list[float]) -> Any:
    """Create decisions that each end a trip; the first feature is the number of the decision."""
    steps = len(rewards)
    shape = (steps, 1, 1)
    observations = torch.zeros(*shape, 3)
    observations[:, 0, 0, 0] = torch.arange(steps)
    return PPO.Batch(
        observations=observations,
        states=torch.zeros(steps, 1, 0),
        actions=torch.zeros(*shape, 2),
        log_probs=torch.zeros(shape),
        values=torch.zeros(shape),
        rewards=torch.tensor(rewards).reshape(shape),
        acted=torch.ones(shape, dtype=torch.bool),
        next_values=torch.zeros(shape),
        goes_on=torch.zeros(shape, dtype=torch.bool),
    )


@pytest.mark.parametrize(("anneal", "rate"), [(True, 0.5), (False, 2.0)])
def test_the_learning_rate_falls_with_the_remaining_updates(anneal: bool, rate: float) -> None:
    found = learner(learning_rate=2.0, anneal=anneal, epochs=1, minibatches=1)
    found.update(batch([1.0, 2.0, 3.0]), 0.25)
    assert [group["lr"] for group in found.optimizer.param_groups] == [rate]


def test_learning_uses_decisions_with_the_largest_absolute_advantages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = learner(keep=0.5, epochs=1, minibatches=1)
    heads, learned = found.network.heads, []

    def noting(seen: Any, states: Any) -> Any:
        learned.append(sorted(seen[:, 0].tolist()))
        return heads(seen, states)

    monkeypatch.setattr(found.network, "heads", noting)
    found.update(batch([3.0, -4.0, 1.0, -2.0]), 1.0)
    assert learned == [[0.0, 1.0]]


@pytest.mark.parametrize("kept", [0.0, 0.75])
def test_the_driver_has_averaged_weights_and_the_latest_observation_scales(kept: float) -> None:
    found = learner(average=kept, learning_rate=0.1, epochs=1, minibatches=1)
    due = {name: tensor.clone() for name, tensor in found.network.state_dict().items()}
    for rewards in ([1.0, 2.0, 3.0], [3.0, -1.0, 2.0]):
        found.update(batch(rewards), 1.0)
        for name, tensor in found.network.state_dict().items():
            share = 0.0 if name in ("mean", "deviation") else kept
            due[name] = share * due[name] + (1.0 - share) * tensor
    for name, tensor in found.averaged.state_dict().items():
        torch.testing.assert_close(tensor, due[name])
    moved = not torch.equal(found.averaged.log_std, found.network.log_std)
    assert moved == (kept > 0.0)
    other = learner(average=kept)
    other.load(found.save())
    for name, tensor in found.averaged.state_dict().items():
        assert other.averaged.state_dict()[name].equal(tensor), name
