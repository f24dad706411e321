"""`ActorCritic`: the torch network that training programs train, and how it is saved.

A trained driver is evaluated without torch, see `cavmarl.networks.driver_network`.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor, nn

from cavmarl.config.driver_form import CONFIG_FILE, WEIGHTS_FILE
from cavmarl.core.atomic_file import write_whole
from cavmarl.networks.network_files import (
    CONTINUOUS_ACTIONS,
    MAX_DEVIATIONS,
    RESIDUAL_PARTS,
    NetworkConfig,
    read_network,
)

LOG_2_PI = math.log(2.0 * math.pi)


class ActorCritic(nn.Module):
    """A policy and a value function: two tanh networks, or two heads of one body with LayerNorm.

    Both networks get observations normalised by `mean` and `deviation`. These buffers are updated
    by training and saved with the weights. With a `state_size`, the
    value function is a central critic, which also gets the state of the whole world (Yu et al.
    2022).

    Continuous actions are normally distributed around the actor's output, with one learned
    deviation per action. The environment gets clipped actions in [-1, 1]; learning uses the
    unclipped actions. Discrete actions are categorical.

    Args:
        config: sizes and kind of action.
        initial_std: initial standard deviations of continuous actions: throttle, steering.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(
        self, config: NetworkConfig, initial_std: tuple[float, float] = (0.5, 0.5)
    ) -> None:
        super().__init__()
        self.continuous = config.action.kind == "continuous"
        self.residual = config.residual
        self.state_size = config.state_size
        actions = config.num_outputs
        self.register_buffer("mean", torch.zeros(config.observation_size))
        self.register_buffer("deviation", torch.ones(config.observation_size))
        # Small last weights: the first policy has no preference (Andrychowicz et al. 2021).
        size = config.observation_size
        self.body = _body((size, *config.hidden)) if config.shared else None
        self.actor: nn.Module
        self.critic: nn.Module
        if config.shared:
            self.actor = _linear(config.hidden[-1], actions, 0.01)
            self.critic = _linear(config.hidden[-1], 1, 1.0)
        else:
            self.actor = _perceptron((size, *config.hidden, actions), last_gain=0.01)
            self.critic = _perceptron((size + config.state_size, *config.hidden, 1), last_gain=1.0)
        if self.continuous:
            self.log_std = nn.Parameter(torch.tensor(initial_std).log())

    @property
    def parts(self) -> list[list[nn.Parameter]]:
        """The groups of weights whose gradients are clipped together."""
        if self.body is not None:
            return [list(self.parameters())]
        return [list(self.actor.parameters()), list(self.critic.parameters())]

    def normal(self, observations: Tensor) -> Tensor:
        """Return observations (…, D) minus their mean, divided by their deviation, and clipped."""
        normal: Tensor = (observations - self.mean) / self.deviation
        return normal.clamp_(-MAX_DEVIATIONS, MAX_DEVIATIONS)

    def heads(self, seen: Tensor, states: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the results of `forward` and `value` for observations already normalised."""
        if self.body is not None:
            seen = self.body(seen)
        judged = seen
        if self.state_size and states is not None:
            judged = torch.cat([seen, states], dim=-1)
        return self.actor(seen), self.critic(judged).squeeze(-1)

    def forward(self, observations: Tensor) -> Tensor:
        """Return the policy's output: means (N, 2) of actions, or logits (N, choices)."""
        seen = self.normal(observations)
        output: Tensor = self.actor(seen if self.body is None else self.body(seen))
        return output

    def value(self, observations: Tensor, states: Tensor | None = None) -> Tensor:
        """Return values (N,) of observations (N, D); a central critic also needs states (N, S)."""
        return self.heads(self.normal(observations), states)[1]

    def best(self, observations: Tensor) -> Tensor:
        """Return the most likely actions: (N, 2) within [-1, 1], or (N,) choices."""
        output = self.forward(observations)
        return self.given(output if self.continuous else output.argmax(-1), observations)

    def given(self, actions: Tensor, observations: Tensor) -> Tensor:
        """Return the environment's actions for sampled actions (…) and observations (…, D)."""
        if not self.continuous:
            return actions
        if self.residual:
            parts = actions.new_tensor(RESIDUAL_PARTS)
            actions = actions * parts + observations[..., -CONTINUOUS_ACTIONS:]
        return actions.clamp(-1.0, 1.0)

    def sample(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return random actions, continuous ones unclipped, and their log probabilities (N,)."""
        return self.draw(self.forward(observations))

    def draw(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Return the result of `sample`, given the output of `forward`."""
        noise = torch.empty_like(output)
        if self.continuous:
            actions = output + noise.normal_() * self.log_std.exp()
        else:
            # The argmax of logits plus Gumbel noise is a sample of the distribution.
            actions = (output - noise.exponential_().log_()).argmax(-1)
        return actions, self._log_prob(output, actions)

    def evaluate(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return log probabilities (N,) of sampled actions, and entropies (N,)."""
        return self.judge(self.forward(observations), actions)

    def judge(self, output: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the result of `evaluate`, given the output of `forward`."""
        if self.continuous:
            entropy = (0.5 + 0.5 * LOG_2_PI + self.log_std).sum().expand(output.shape[0])
            return self._log_prob(output, actions), entropy
        log_probs = output.log_softmax(-1)
        entropy = -(log_probs.exp() * log_probs).sum(-1)
        return log_probs.gather(-1, actions.unsqueeze(-1)).squeeze(-1), entropy

    def distance(self, output: Tensor, actions: Tensor) -> Tensor:
        """Return imitation losses (N,) of `forward`'s output: squared errors or cross-entropy."""
        if self.continuous:
            return (output - actions).square().sum(-1)
        return nn.functional.cross_entropy(output, actions, reduction="none")

    def _log_prob(self, output: Tensor, actions: Tensor) -> Tensor:
        if self.continuous:
            scaled = (actions - output) * (-self.log_std).exp()
            return (-0.5 * (scaled * scaled + LOG_2_PI) - self.log_std).sum(-1)
        return output.log_softmax(-1).gather(-1, actions.unsqueeze(-1)).squeeze(-1)


def _perceptron(sizes: tuple[int, ...], last_gain: float) -> nn.Sequential:
    """Return linear layers with tanh between them and orthogonal weights."""
    layers: list[nn.Module] = []
    last = len(sizes) - 2
    for k, (inputs, outputs) in enumerate(pairwise(sizes)):
        layer = _linear(inputs, outputs, last_gain if k == last else math.sqrt(2.0))
        layers += [layer] if k == last else [layer, nn.Tanh()]
    return nn.Sequential(*layers)


def _body(sizes: tuple[int, ...]) -> nn.Sequential:
    """Return linear layers with LayerNorm (Ba et al. 2016) and ReLU, orthogonal weights."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [_linear(inputs, outputs, math.sqrt(2.0)), nn.LayerNorm(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


def _linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def save_network(folder: Path, network: ActorCritic, config: NetworkConfig) -> None:
    """Write weights and config into `folder`; an interrupted write leaves the old files intact."""
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    write_whole(folder / WEIGHTS_FILE, save(weights))
    text = json.dumps(asdict(config), indent=2) + "\n"
    write_whole(folder / CONFIG_FILE, text.encode())


def load_network(folder: Path) -> tuple[ActorCritic, NetworkConfig]:
    """Read a network written by `save_network`, for further training; raises as `read_network`."""
    weights, config = read_network(folder)
    network = ActorCritic(config)
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in weights.items()})
    return network.eval(), config
