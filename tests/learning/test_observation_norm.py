"""Running means and deviations of observations, compared with hand-computed values."""

from __future__ import annotations

import math
from copy import deepcopy
from pathlib import Path

import pytest
import torch

from cavmarl.config.action import ActionConfig
from cavmarl.config.sensors import SensorsConfig
from cavmarl.learning import observation_norm
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.learning.observation_norm import Scales
from cavmarl.networks.network_files import NetworkConfig


def network() -> ActorCritic:
    """Create a network that observes two numbers."""
    return ActorCritic(NetworkConfig("merge", 2, SensorsConfig(), ActionConfig(), (4,)))


def test_the_scales_of_two_batches_are_those_of_all_observations() -> None:
    observer = network()
    scales = Scales(observer)
    scales.add(torch.tensor([[0.0, 3.0], [2.0, 3.0]]))
    assert observer.mean.tolist() == pytest.approx([1.0, 3.0])
    assert observer.deviation[0].item() == pytest.approx(1.0)
    scales.add(torch.zeros(0, 2))
    scales.add(torch.tensor([[10.0, 3.0], [12.0, 3.0], [14.0, 3.0]]))
    # The mean of 0, 2, 10, 12, 14 is 7.6; the sum of squared differences from the mean is 155.2.
    assert observer.mean.tolist() == pytest.approx([7.6, 3.0])
    assert observer.deviation[0].item() == pytest.approx(math.sqrt(155.2 / 5.0))
    assert observer.deviation[1].item() == pytest.approx(0.02), (
        "the deviation of a constant has a lower bound"
    )


def test_scales_of_a_start_driver_are_weighted_by_its_number_of_decisions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    observer = network()

    def begin(started: ActorCritic, config: NetworkConfig, folder: Path) -> int:
        started.mean.copy_(torch.tensor([1.0, 0.0]))
        started.deviation.copy_(torch.tensor([2.0, 1.0]))
        return 10

    monkeypatch.setattr(observation_norm, "begin_with", begin)
    scales = Scales(observer)
    scales.start(NetworkConfig("merge", 2, SensorsConfig(), ActionConfig(), (4,)), Path())
    scales.add(torch.tensor([[3.0, 0.0], [5.0, 0.0]]))
    # Ten values 1 ± 2 and two values 4 ± 1 have the mean 1.5. The sum of squared differences from
    # the mean is 10 · 2² + 2 · 1² + 10 · 2 / 12 · 3² = 57.
    assert observer.mean[0].item() == pytest.approx(1.5)
    assert observer.deviation[0].item() == pytest.approx(math.sqrt(57.0 / 12.0))


def test_loaded_scales_continue_with_the_same_numbers() -> None:
    first, second = torch.tensor([[0.0, 1.0], [2.0, 5.0]]), torch.tensor([[10.0, 9.0]])
    whole, cut = network(), network()
    scales = Scales(whole)
    scales.add(first)
    saved = deepcopy(scales.save())
    cut.load_state_dict(whole.state_dict())
    scales.add(second)
    resumed = Scales(cut)
    resumed.load(saved)
    resumed.add(second)
    # The mean of 0, 2, 10 is 4; the sum of squared differences from the mean is 56.
    assert cut.mean.tolist() == pytest.approx([4.0, 5.0])
    assert cut.deviation[0].item() == pytest.approx(math.sqrt(56.0 / 3.0))
    assert torch.equal(cut.deviation, whole.deviation)
