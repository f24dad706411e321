"""`Opponents`: fixed drivers that drive for some agents; training ignores what they experience."""

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
    """Fixed drivers, each for about `share` of the agents, which are drawn at random.

    The object also loads drivers to imitate, see `example`.

    Attributes:
        absent: (W, A) agents of the learning driver, which have no opponent.
    """

    def __init__(self, names: str, vec: CavVectorEnv, share: float, seed: int) -> None:
        """Load the comma-separated `names`. Raises PolicyError: a driver does not fit `vec`."""
        self._vec, self._seed = vec, seed
        self._drivers = [load_policy(name, vec) for name in names.split(",") if name]
        self._to_reset = [*self._drivers]
        drawn = np.random.default_rng(seed).random((vec.num_envs, vec.num_agents))
        self._seats = np.floor(drawn / max(share, 1e-9))  # index of each agent's driver
        self.absent: Mask = self._seats >= len(self._drivers)

    def begin(self) -> None:
        """Reset all drivers with the seed, so that they act the same in a resumed run."""
        for driver in self._to_reset:
            driver.reset(self._seed)

    def example(self, name: str) -> Callable[[Tensor, Mask], Tensor]:
        """Return a function that gives a driver's actions (W, A, …); '': the built-in driver."""
        if not name:
            return lambda observations, mask: torch.from_numpy(self._vec.suggest_actions())
        driver = load_policy(name, self._vec)
        self._to_reset.append(driver)
        return lambda observations, mask: torch.from_numpy(
            driver.act_batch(observations.numpy(), mask)
        )

    def act(self, observations: NDArray[np.float32], mask: Mask, actions: NDArray[Any]) -> None:
        """Overwrite the actions (W, A, …) of the agents that opponents drive."""
        for k, driver in enumerate(self._drivers):
            theirs = self._seats == k
            actions[theirs] = driver.act_batch(observations, mask & theirs)[theirs]
