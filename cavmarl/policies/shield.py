"""`ShieldedPolicy`: a driver that the built-in driver overrides where it would brake harder."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.policies.policy import Environment, Policy, built_in_actions


class ShieldedPolicy(Policy):
    """Uses the built-in driver's action if that action brakes, and brakes harder than the driver's.

    The built-in driver reads the world's state, not observations. So results with a shield are not
    comparable with results of the driver alone.
    """

    def __init__(self, env: Environment, driver: Policy) -> None:
        super().__init__(env)
        self.driver = driver

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode of the driver."""
        self.driver.reset(seed)

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return the actions (W, A, 2); the built-in driver's actions where they brake harder.

        Raises PolicyError: actions are discrete.
        """
        safe = built_in_actions(self.env, mask)
        actions = self.driver.act_batch(observations, mask).copy()
        relieved = (safe[..., 0] < 0.0) & (safe[..., 0] < actions[..., 0])
        actions[relieved] = safe[relieved]
        return actions
