"""`ShieldedPolicy`: a driver that the built-in one relieves where it would brake harder."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.policies.policy import Environment, Policy, built_in_actions


class ShieldedPolicy(Policy):
    """Where the built-in driver would brake, and harder, its action is done and not the driver's.

    The built-in driver reads the world's state, not observations: results with a shield stand
    apart from those of the driver alone.
    """

    def __init__(self, env: Environment, driver: Policy) -> None:
        super().__init__(env)
        self.driver = driver

    def reset(self, seed: int | None = None) -> None:
        """Begin anew, as the driver does."""
        self.driver.reset(seed)

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """The driver's actions (W, A, 2), or the built-in driver's.

        Raises PolicyError: actions are numbers of choices.
        """
        safe = built_in_actions(self.env, mask)
        actions = self.driver.act_batch(observations, mask).copy()
        relieved = (safe[..., 0] < 0.0) & (safe[..., 0] < actions[..., 0])
        actions[relieved] = safe[relieved]
        return actions
