"""`Scales`: normalisation of observations, learned together with the weights."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.learning.checkpoint import Parts
from cavmarl.learning.warm_start import begin_with
from cavmarl.networks.network_files import NetworkConfig

LEAST_DEVIATION = 0.02  # minimum, so that nearly constant observations are not amplified


class Scales:
    """Updates the network's mean and deviation of observations over all decisions of a run."""

    def __init__(self, network: ActorCritic) -> None:
        self._network = network
        self._count = 0
        self._squares = torch.zeros_like(network.deviation)

    def start(self, config: NetworkConfig, folder: Path) -> None:
        """Start with the weights and the scales of a driver, see `begin_with`."""
        self._count = begin_with(self._network, config, folder)
        self._squares = self._network.deviation.square() * self._count

    def add(self, observations: Tensor) -> None:
        """Add the observations (N, D) of new decisions (Chan et al. 1979)."""
        network, new = self._network, len(observations)
        if new == 0:
            return
        squares, mean = torch.var_mean(observations, 0, correction=0)
        apart, total = mean - network.mean, self._count + new
        self._squares += squares * new + apart.square() * (self._count * new / total)
        network.mean += apart * (new / total)
        network.deviation.copy_((self._squares / total).sqrt().clamp(min=LEAST_DEVIATION))
        self._count = total

    def save(self) -> Parts:
        return {"count": self._count, "squares": self._squares}

    def load(self, saved: Parts) -> None:
        self._count, self._squares = saved["count"], saved["squares"].to(self._squares.device)
