"""`Opponents`: drivers that nothing is learnt from have some of the seats."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.loading import load_policy

Mask = NDArray[np.bool_]


class Opponents:
    """Each has its share of the seats, drawn once; besides, a driver may set an example.

    Attributes:
        absent: (W, A) seats of the driver that learns.
    """

    def __init__(self, names: str, vec: CavVectorEnv, share: float, seed: int) -> None:
        """`names`: of drivers, by commas. Raises PolicyError: one of them cannot drive here."""
        self._vec, self._seed = vec, seed
        self._drivers = [load_policy(name, vec) for name in names.split(",") if name]
        self._to_reset = [*self._drivers]
        drawn = np.random.default_rng(seed).random((vec.num_envs, vec.num_agents))
        self._seats = np.floor(drawn / max(share, 1e-9))  # which driver has each
        self.absent: Mask = self._seats >= len(self._drivers)

    def begin(self) -> None:
        """Begin anew, so that a run that goes on has the same ones."""
        for driver in self._to_reset:
            driver.reset(self._seed)

    def example(self, name: str) -> Callable[[Tensor, Mask], Tensor]:
        """What gives the actions (W, A, …) of a driver that is imitated; '': the built-in one."""
        if not name:
            return lambda observations, mask: torch.from_numpy(self._vec.suggest_actions())
        driver = load_policy(name, self._vec)
        self._to_reset.append(driver)
        return lambda observations, mask: torch.from_numpy(
            driver.act_batch(observations.numpy(), mask)
        )

    def act(self, observations: NDArray[np.float32], mask: Mask, actions: NDArray[Any]) -> None:
        """Write their actions (W, A, …) in the place of others."""
        for k, driver in enumerate(self._drivers):
            theirs = self._seats == k
            actions[theirs] = driver.act_batch(observations, mask & theirs)[theirs]
