"""A driver that sees no other vehicle and no signal: an opponent that teaches caution.

It steers like the built-in driver and keeps its own target speed: a share of the speed limit, drawn
per seat. It needs `sensors.ego` and continuous actions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.engine.spaces import observation_parts
from cavmarl.policies.policy import Environment, Policy, built_in_actions

LEAST, MOST = 0.5, 1.1  # as a share of the limit
REACT_S = 1.0

# Indices of `ego` features and their scale, see the table of any environment's card.
SPEED, LIMIT = 0, 6
SPEED_SCALE = 40.0


class BlindPolicy(Policy):
    """Follows its lane at a share of the speed limit, drawn from the seed of `reset`."""

    def __init__(self, env: Environment) -> None:
        super().__init__(env)
        parts = observation_parts(env.config.sensors)
        if "ego" not in parts:
            raise PolicyError("blind needs its own speed: set sensors.ego.enabled = true")
        self._ego = parts["ego"].place
        self._frame = max(part.place.stop for part in parts.values())
        self.reset(0)

    def reset(self, seed: int | None = None) -> None:
        """Draw the shares again; None draws a seed from the operating system."""
        self._random = np.random.Generator(np.random.Philox(seed))
        self._shares = np.zeros((0, 0))

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return (W, A, 2): the built-in driver's steering, and throttle for the target speed."""
        if self._shares.shape != mask.shape:
            self._shares = self._random.uniform(LEAST, MOST, mask.shape)
        actions = built_in_actions(self.env, mask)
        ego = observations[..., -self._frame :][..., self._ego]
        missing_mps = SPEED_SCALE * (self._shares * ego[..., LIMIT] - ego[..., SPEED])
        throttle = missing_mps / REACT_S / self.env.config.action.acceleration_mps2
        actions[..., 0] = np.clip(throttle, -1.0, 0.5)
        return actions


def make_policy(env: Environment) -> Policy:
    """Create the driver."""
    return BlindPolicy(env)
