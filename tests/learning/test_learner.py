"""The weights and rates of PPO's update over a run, by hand."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from cavmarl.config.action import ActionConfig
from cavmarl.config.sensors import SensorsConfig
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.policies.network_files import NetworkConfig
from tests.support.training import load_program

PPO = load_program("ppo")


def learner(**settings: Any) -> Any:
    """It observes three numbers."""
    torch.manual_seed(0)
    network = ActorCritic(NetworkConfig("merge", 3, SensorsConfig(), ActionConfig(), (4,)))
    return PPO.Learner(network, PPO.Args(**settings))


@pytest.mark.parametrize(
    ("left", "weight"), [(1.0, 2.0), (0.875, 1.0), (0.8, 0.4), (0.75, 0.0), (0.3, 0.0)]
)
def test_imitation_ends_after_its_share_of_the_run(left: float, weight: float) -> None:
    found = learner(imitation_weight=2.0, imitation_share=0.25)
    assert found.imitation_weight(left) == pytest.approx(weight)
