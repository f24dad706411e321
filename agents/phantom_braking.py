"""The built-in driver with occasional phantom braking: an opponent that teaches distance.

Frequency, strength and duration of the braking are drawn per seat. It needs continuous actions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.policies.policy import Environment, Policy, built_in_actions

BETWEEN_S = (5.0, 30.0)  # range of the mean time between two brakings
LONG_S = (0.5, 3.0)
BRAKE_MPS2 = (2.0, 6.0)


class PhantomBrakingPolicy(Policy):
    """Draws its brakings from the seed of `reset` and the number of decisions since then."""

    def __init__(self, env: Environment) -> None:
        super().__init__(env)
        self.reset(0)

    def reset(self, seed: int | None = None) -> None:
        """Draw again; None draws a seed from the operating system."""
        self._random = np.random.Generator(np.random.Philox(seed))
        self._left_s = np.zeros((0, 0))

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return (W, A, 2): the built-in driver's actions, or the brake."""
        draw = self._random.uniform
        if self._left_s.shape != mask.shape:
            self._left_s = np.zeros(mask.shape)
            self._between_s = draw(*BETWEEN_S, mask.shape)
            self._brake_mps2 = draw(*BRAKE_MPS2, mask.shape)
        step_s = self.env.config.clock.ctrl_dt_s
        begins = draw(0.0, 1.0, mask.shape) < step_s / self._between_s
        long_s = draw(*LONG_S, mask.shape)
        self._left_s = np.where(begins, long_s, self._left_s - step_s)
        actions = built_in_actions(self.env, mask)
        throttle = -self._brake_mps2 / self.env.config.action.acceleration_mps2
        braked = np.minimum(actions[..., 0], np.maximum(throttle, -1.0))
        actions[..., 0] = np.where(self._left_s > 0.0, braked, actions[..., 0])
        return actions


def make_policy(env: Environment) -> Policy:
    """Create the driver."""
    return PhantomBrakingPolicy(env)
