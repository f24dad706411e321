"""The built-in driver: IDM, MOBIL with route-dependent lane changes, and a lane controller.

It drives like background vehicles, from the world's state instead of observations. As an agent, it
is the baseline for policies that use only sensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.policy import Policy, suggested


class IdmPolicy(Policy):
    """Acts as the built-in driver would in each agent's place."""

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return the built-in driver's actions (W, A, …) in the present worlds."""
        if isinstance(self.env, CavEnv):
            raise PolicyError("act_batch() drives a make_vec; a parallel_env is driven by act()")
        return cast(NDArray[Any], suggested(self.env))

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the built-in driver's actions in the present world."""
        if isinstance(self.env, CavVectorEnv):
            raise PolicyError("act() drives a parallel_env; a make_vec is driven by act_batch()")
        return cast(dict[str, Any], suggested(self.env))


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Create the built-in driver."""
    return IdmPolicy(env)
