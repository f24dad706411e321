"""`ShieldedPolicy`: a driver that the built-in one relieves where it would brake harder."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.env.parallel import CavEnv
from cavmarl.policies.policy import Environment, Policy


class ShieldedPolicy(Policy):
    """Where the built-in driver would brake, and harder, its action is done and not the driver's.

    The built-in driver reads the world's state, not observations: results with a shield stand
    apart from those of the driver alone.
    """

    def __init__(self, env: Environment, driver: Policy) -> None:
        """Raises PolicyError: actions are numbers of choices."""
        super().__init__(env)
        if env.config.action.kind != "continuous":
            raise PolicyError(
                f"shielded: compares throttles, but action.kind = {env.config.action.kind}; "
                "drive without a shield, or with action.kind = continuous"
            )
        self.driver = driver

    def reset(self, seed: int | None = None) -> None:
        """Begin anew, as the driver does."""
        self.driver.reset(seed)

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """The driver's actions (W, A, 2), or the built-in driver's."""
        actions = self.driver.act_batch(observations, mask).copy()
        safe = self._suggested(mask)
        relieved = (safe[..., 0] < 0.0) & (safe[..., 0] < actions[..., 0])
        actions[relieved] = safe[relieved]
        return actions

    def _suggested(self, mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        """What the built-in driver would do, (W, A, 2)."""
        found = self.env.suggest_actions()
        if not isinstance(self.env, CavEnv):
            return np.asarray(found)
        suggested = np.zeros((*mask.shape, 2), dtype=np.float32)
        for k, agent in enumerate(self.env.possible_agents):
            if agent in found:
                suggested[0, k] = found[agent]
        return suggested
