"""`MovingOff`: which vehicles should move off, and what PPO's update does with them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from cavmarl.config.action import ActionConfig
from cavmarl.config.sensors import EgoConfig, SensorsConfig, WayConfig
from cavmarl.core.errors import ConfigError
from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.learning.moving_off import MovingOff, is_held_back, move_off_loss
from cavmarl.networks.network_files import NetworkConfig
from cavmarl.sensors.observed import feature_names
from tests.support.training import load_program

PPO = load_program("ppo")
SENSORS = SensorsConfig(way=WayConfig(distances_m=(5.0,), lines=1, range_m=100.0))


def observed(speed_mps: float, **features: float) -> Tensor:
    names = feature_names(SENSORS)
    numbers = torch.zeros(len(names))
    numbers[names.index(("ego", "speed"))] = speed_mps / 40.0
    for name, value in features.items():
        numbers[names.index(("way", name))] = value
    return numbers


def test_a_standing_vehicle_should_move_off_if_the_built_in_driver_would() -> None:
    cases = [
        (observed(0.0), 0.5, True),
        (observed(0.4, line_green_0=1.0), 0.5, True),
        (observed(0.0, line_yields_0=1.0), 0.5, True),
        (observed(0.6), 0.5, False),  # it moves
        (observed(0.0), 0.05, False),  # the built-in driver would wait
        (observed(0.0), -1.0, False),
        (observed(0.0, line_red_0=1.0), 0.5, False),
        (observed(0.0, line_yellow_0=1.0), 0.5, False),
    ]
    suggested = torch.tensor([[throttle, 0.0] for _, throttle, _ in cases])
    found = MovingOff(SENSORS, ActionConfig()).reluctant(
        torch.stack([numbers for numbers, _, _ in cases]), suggested
    )
    assert found.tolist() == [expected for _, _, expected in cases]


def test_the_loss_is_the_squared_lack_of_throttle_of_these_vehicles() -> None:
    output = torch.tensor([[0.1, 0.9], [-0.7, 0.0], [0.3, 0.0], [-0.7, 0.0]])
    reluctant = torch.tensor([True, True, True, False])
    assert move_off_loss(output, reluctant).item() == pytest.approx((0.2**2 + 1.0) / 4.0)
    assert is_held_back(output).tolist() == [True, True, False, True]


@pytest.mark.parametrize("weight", [0.0, 0.5])
def test_learning_raises_the_throttle_of_a_standing_vehicle_without_advantage(
    weight: float,
) -> None:
    """With `keep`, PPO leaves out the decision of the standing vehicle, but this loss does not."""
    torch.manual_seed(0)
    steps, size = 4, len(feature_names(SENSORS))
    network = ActorCritic(NetworkConfig("merge", size, SENSORS, ActionConfig(), (4,)))
    args = PPO.Args(
        move_off_weight=weight, keep=0.5, epochs=1, minibatches=1, max_gradient_norm=10.0
    )
    found = PPO.Learner(network, args, moving_off=MovingOff(SENSORS, ActionConfig()))
    shape = (steps, 1, 1)
    waiting = observed(0.0)
    observations = torch.stack([waiting, *[observed(10.0)] * (steps - 1)]).reshape(*shape, size)
    batch = PPO.Batch(
        observations=observations,
        states=torch.zeros(steps, 1, 0),
        actions=torch.zeros(*shape, 2),
        log_probs=torch.zeros(shape),
        values=torch.zeros(shape),
        rewards=torch.tensor([0.0, 1.0, -1.0, 0.5]).reshape(shape),
        acted=torch.ones(shape, dtype=torch.bool),
        next_values=torch.zeros(shape),
        goes_on=torch.zeros(shape, dtype=torch.bool),
        suggested=torch.full((*shape, 2), 0.5) if weight else None,
    )
    learned: list[int] = []
    heads = network.heads

    def noting(seen: Tensor, states: Any) -> Any:
        learned.append(int((seen[:, 0] < 0.1).sum()))
        return heads(seen, states)

    network.heads = noting  # type: ignore[method-assign]
    before = network(waiting[None])[0, 0].item()
    found.update(batch, 1.0)
    after = network(waiting[None])[0, 0].item()
    assert learned == [int(weight > 0.0)]
    if weight:
        assert after > before


@pytest.mark.parametrize(
    ("sensors", "action"),
    [
        (replace(SENSORS, ego=EgoConfig(enabled=False)), ActionConfig()),
        (replace(SENSORS, stack=2), ActionConfig()),
        (SENSORS, ActionConfig(kind="discrete")),
    ],
)
def test_moving_off_needs_the_own_speed_and_continuous_actions(
    sensors: SensorsConfig, action: ActionConfig
) -> None:
    with pytest.raises(ConfigError, match=r"--move-off-weight: needs sensors\.ego"):
        MovingOff(sensors, action)
