"""`GreenPolicy`: a policy of stable-baselines3 for signals with any numbers of lanes and greens.

`SharedNetwork` is a controller that uses a trained policy of this kind.

Importing this module loads stable-baselines3 and torch; `import cavmarl` does not import it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import missing
from cavmarl.signals.controllers import SignalView
from cavmarl.signals.green_features import GREEN_FEATURES, GreenFeatures
from cavmarl.signals.kernels.green_choices import KEEP

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.policies import ActorCriticPolicy
    from torch import Tensor, nn
except ModuleNotFoundError as error:
    raise missing(error.name, "train") from error

EXISTS, ALLOWED = GREEN_FEATURES.index("exists"), GREEN_FEATURES.index("allowed")
FORBIDDEN = -1e8  # logit of a green that may not be chosen
FIRST_GAIN = 0.01  # gain of the logits, so that allowed greens are about equally likely at first


class GreenNetwork(nn.Module):
    """Actor and critic on the rows of `GreenFeatures`.

    The same layers embed each green. The actor scores a green from its own embedding, and the mean
    and maximum over all greens of the signal. The critic reads the mean and maximum.

    Args:
        num_greens: G.
        num_shared: number of values of a row that do not belong to a green.
        width: width of the hidden layers.
    """

    def __init__(self, num_greens: int, num_shared: int, width: int) -> None:
        super().__init__()
        self._shape = (num_greens, len(GREEN_FEATURES))
        self.latent_dim_pi, self.latent_dim_vf = num_greens, width
        inputs = len(GREEN_FEATURES) + num_shared
        self.embed = nn.Sequential(nn.Linear(inputs, width), nn.ReLU())
        self.embed_value = nn.Sequential(nn.Linear(inputs, width), nn.ReLU())
        self.score = nn.Sequential(nn.Linear(3 * width, width), nn.ReLU())
        self.last = nn.Linear(width, 1)
        self.value = nn.Sequential(nn.Linear(2 * width + num_shared, width), nn.ReLU())

    def forward(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the logits (n, G), and the inputs (n, width) of the critic's last layer."""
        return self.forward_actor(rows), self.forward_critic(rows)

    def forward_actor(self, rows: Tensor) -> Tensor:
        """Return the logits (n, G); forbidden greens have very low logits."""
        greens, _, inputs = self._split(rows)
        embedded = self.embed(inputs)
        pooled = _pooled(embedded, greens[..., EXISTS, None])
        every = torch.cat([embedded, pooled[:, None].expand(-1, self._shape[0], -1)], dim=-1)
        logits = self.last(self.score(every))[..., 0]
        return torch.where(greens[..., ALLOWED] > 0.5, logits, torch.full_like(logits, FORBIDDEN))

    def forward_critic(self, rows: Tensor) -> Tensor:
        """Return the inputs (n, width) of the critic's last layer."""
        greens, shared, inputs = self._split(rows)
        pooled = _pooled(self.embed_value(inputs), greens[..., EXISTS, None])
        found: Tensor = self.value(torch.cat([pooled, shared], dim=-1))
        return found

    def _split(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the features (n, G, F) of greens, shared values (n, C), both as (n, G, F + C)."""
        num_greens, size = self._shape
        greens = rows[:, : num_greens * size].reshape(-1, num_greens, size)
        shared = rows[:, num_greens * size :]
        both = torch.cat([greens, shared[:, None].expand(-1, num_greens, -1)], dim=-1)
        return greens, shared, both


class GreenPolicy(ActorCriticPolicy):
    """A policy with a `GreenNetwork`, whose arguments are the policy's option `net_arch`."""

    def _build_mlp_extractor(self) -> None:
        self.add_module("mlp_extractor", GreenNetwork(*self.net_arch))

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        network = self.get_submodule("mlp_extractor.last")
        self.init_weights(network, FIRST_GAIN)
        self.action_net = nn.Identity()  # the network's outputs are the logits


class SharedNetwork:
    """A controller that chooses each signal's most likely green by one shared network.

    Args:
        model: a model trained on the rows of `CavSb3SignalEnv` with `features="greens"`.
    """

    def __init__(self, model: PPO) -> None:
        self._model = model
        self._features: GreenFeatures | None = None

    def choose(self, view: SignalView) -> NDArray[np.int64]:
        """Return the choice (W, S) of each agent; KEEP where no decision is due."""
        shape = view.states.shape[:2]
        if not view.decides.any():
            return np.full(shape, KEEP)
        if self._features is None:
            self._features = GreenFeatures(view.table)
        rows = self._features.of(view).reshape(shape[0] * shape[1], -1)
        actions = self._model.predict(rows, deterministic=True)[0].reshape(shape)
        return np.where(view.decides[:, None], actions, KEEP)


def _pooled(embedded: Tensor, exists: Tensor) -> Tensor:
    """Return the mean and the maximum (n, 2 · width) over the greens that exist."""
    kept = embedded * exists
    mean = kept.sum(dim=1) / exists.sum(dim=1).clamp(min=1.0)
    return torch.cat([mean, kept.max(dim=1).values], dim=-1)
