"""Keeps its speed whatever comes: what scenarios must not let pass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from cavmarl.cav_env import CavEnv
from cavmarl.errors import PolicyError
from cavmarl.policies import Policy
from cavmarl.vector_env import CavVectorEnv


class NeverYieldPolicy(Policy):
    """Steers as the built-in driver does, and neither brakes nor speeds up."""

    def __init__(self, env: CavEnv | CavVectorEnv) -> None:
        super().__init__(env)
        if env.config.action.kind != "continuous":
            raise PolicyError(
                "never_yield needs action.kind = continuous: meta-actions say no acceleration"
            )

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """(W, A, 2): no throttle, and the built-in driver's steering."""
        if isinstance(self.env, CavEnv):
            raise PolicyError("act_batch() drives a make_vec; a parallel_env is driven by act()")
        actions = cast(NDArray[Any], self.env.suggest_actions()).copy()
        actions[..., 0] = 0.0
        return actions

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """The same by agent."""
        if isinstance(self.env, CavVectorEnv):
            raise PolicyError("act() drives a parallel_env; a make_vec is driven by act_batch()")
        return {
            agent: np.array([0.0, action[1]], dtype=np.float32)
            for agent, action in self.env.suggest_actions().items()
        }


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Seat a driver that never yields."""
    return NeverYieldPolicy(env)
