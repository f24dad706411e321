"""`Scales`: normalisation of observations, learned together with the weights."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from cavmarl.learning.actor_critic import ActorCritic
from cavmarl.learning.checkpoint import Parts
from cavmarl.learning.data_parallel import ALONE, Ranks
from cavmarl.learning.warm_start import begin_with
from cavmarl.networks.network_files import NetworkConfig

LEAST_DEVIATION = 0.02  # minimum, so that nearly constant observations are not amplified


class Scales:
    """Updates the network's mean and deviation of observations over all decisions of a run."""

    def __init__(self, network: ActorCritic, ranks: Ranks = ALONE) -> None:
        self._network, self._ranks = network, ranks
        self._count = 0
        self._squares = torch.zeros_like(network.deviation)

    def start(self, config: NetworkConfig, folder: Path) -> None:
        """Start with the weights and the scales of a driver, see `begin_with`."""
        self._count = begin_with(self._network, config, folder)
        self._squares = self._network.deviation.square() * self._count

    def add(self, observations: Tensor) -> None:
        """Add the observations (N, D) of new decisions, of all processes (Chan et al. 1979)."""
        mine = None
        if len(observations):
            mine = (len(observations), *torch.var_mean(observations, 0, correction=0))
        for found in self._ranks.gather(mine):
            if found is not None:
                self._merge(*found)

    def _merge(self, new: int, squares: Tensor, mean: Tensor) -> None:
        """Add observations by their number, variances and means."""
        network = self._network
        squares, mean = squares.to(network.mean.device), mean.to(network.mean.device)
        apart, total = mean - network.mean, self._count + new
        self._squares += squares * new + apart.square() * (self._count * new / total)
        network.mean += apart * (new / total)
        network.deviation.copy_((self._squares / total).sqrt().clamp(min=LEAST_DEVIATION))
        self._count = total

    def save(self) -> Parts:
        return {"count": self._count, "squares": self._squares}

    def load(self, saved: Parts) -> None:
        self._count, self._squares = saved["count"], saved["squares"].to(self._squares.device)
