"""Probabilities, entropies and distances of actions, compared with hand-computed values."""

from __future__ import annotations

import math

import pytest
import torch

from cavmarl.config.action import ActionConfig
from cavmarl.config.sensors import SensorsConfig
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.networks.network_files import NetworkConfig


def network(kind: str, *, residual: bool = False) -> ActorCritic:
    action = ActionConfig(kind=kind)  # type: ignore[arg-type]
    config = NetworkConfig("merge", 4, SensorsConfig(), action, (4,), residual=residual)
    return ActorCritic(config, (0.5, 0.25))


def test_continuous_actions_have_a_normal_distribution() -> None:
    output, actions = torch.tensor([[0.1, -0.2]]), torch.tensor([[0.6, -0.2]])
    log_prob, entropy = network("continuous").judge(output, actions)
    # A normal distribution has the entropy ln(σ √(2πe)) and the density exp(-z² / 2) / (σ √(2π)).
    assert entropy.item() == pytest.approx(math.log(0.5 * 0.25 * 2.0 * math.pi * math.e))
    assert log_prob.item() == pytest.approx(-0.5 - math.log(0.5 * 0.25 * 2.0 * math.pi))
    distance = network("continuous").distance(output, torch.tensor([[0.4, 0.2]]))
    assert distance.item() == pytest.approx(0.3**2 + 0.4**2)


def test_discrete_actions_have_the_probabilities_of_their_logits() -> None:
    odds = [1.0, 2.0, 3.0, 4.0]
    output = torch.tensor([[*odds, 0.0]]).log().clamp(min=-80.0)
    log_prob, entropy = network("discrete").judge(output, torch.tensor([2]))
    assert log_prob.exp().item() == pytest.approx(0.3)
    by_hand = -sum(0.1 * odd * math.log(0.1 * odd) for odd in odds)
    assert entropy.item() == pytest.approx(by_hand)
    distance = network("discrete").distance(output, torch.tensor([3]))
    assert distance.item() == pytest.approx(-math.log(0.4))


def test_a_residual_network_adds_all_of_its_throttle_and_a_tenth_of_its_steering() -> None:
    observations = torch.tensor([[9.0, 9.0, 0.3, -0.5]])
    given = network("continuous", residual=True).given(torch.tensor([[0.2, 1.0]]), observations)
    assert given[0].tolist() == pytest.approx([0.5, -0.4])
    clipped = network("continuous", residual=True).given(torch.tensor([[2.0, -9.0]]), observations)
    assert clipped[0].tolist() == [1.0, -1.0]


def test_normalized_observations_are_clipped_at_five_deviations() -> None:
    observer = network("continuous")
    observer.mean += torch.tensor([1.0, 0.0, 0.0, 0.0])
    observer.deviation *= 2.0
    seen = observer.normal(torch.tensor([[5.0, 9.0, 11.0, -11.0]]))
    assert seen[0].tolist() == [2.0, 4.5, 5.0, -5.0]
