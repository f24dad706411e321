"""`Scales`: keeps what a network takes for usual observations."""

from __future__ import annotations

from torch import Tensor

from cavmarl.policies.networks import ActorCritic

LEAST_DEVIATION = 0.02  # of an observation; those that hardly change are not blown up


class Scales:
    """Keeps the network's mean and deviation of observations: of all decisions of a run so far.

    Args:
        network: whose `mean` and `deviation` are kept.
        count: decisions that they are of already.
    """

    def __init__(self, network: ActorCritic, count: int) -> None:
        self._network = network
        self._count = count
        self._squares = network.deviation.square() * count

    def add(self, observations: Tensor) -> None:
        """Take in the observations (N, D) of new decisions (Chan et al. 1979)."""
        network, new = self._network, observations.shape[0]
        if new == 0:
            return
        mean = observations.mean(0)
        apart = mean - network.mean
        total = self._count + new
        self._squares += (observations - mean).square().sum(0)
        self._squares += apart.square() * (self._count * new / total)
        network.mean += apart * (new / total)
        network.deviation.copy_((self._squares / total).sqrt().clamp(min=LEAST_DEVIATION))
        self._count = total
