"""Uniformly random actions: the baseline that every policy must beat."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.policy import Policy


class RandomPolicy(Policy):
    """Draws every action from the seed of `reset` and the number of the step."""

    def __init__(self, env: CavEnv | CavVectorEnv) -> None:
        super().__init__(env)
        self.reset(0)

    def reset(self, seed: int | None = None) -> None:
        """Begin a new sequence; None draws a seed from the operating system."""
        self._random = np.random.Generator(np.random.Philox(seed))

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Draw uniformly from the action space, for every agent."""
        if self.env.config.action.kind == "continuous":
            return self._random.uniform(-1.0, 1.0, (*mask.shape, 2)).astype(np.float32)
        return self._random.integers(0, self.env.config.action.choices, mask.shape)


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Create random actions."""
    return RandomPolicy(env)
