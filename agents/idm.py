"""The built-in driver: IDM, MOBIL with the needs of the route, and a lane controller.

It drives as background vehicles do, from the world's state and not from observations. As an agent
it is the yardstick for policies that have only their sensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.policy import Policy


class IdmPolicy(Policy):
    """Does what the built-in driver would do in each agent's place."""

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """The built-in driver's actions (W, A, …) in the worlds as they are now."""
        if isinstance(self.env, CavEnv):
            raise PolicyError("act_batch() drives a make_vec; a parallel_env is driven by act()")
        return cast(NDArray[Any], self.env.suggest_actions())

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """The built-in driver's actions in the world as it is now."""
        if isinstance(self.env, CavVectorEnv):
            raise PolicyError("act() drives a parallel_env; a make_vec is driven by act_batch()")
        return self.env.suggest_actions()


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Seat the built-in driver."""
    return IdmPolicy(env)
