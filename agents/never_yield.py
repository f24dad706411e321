"""A driver that always keeps its lane and its speed: scenarios must detect its mistakes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import PolicyError
from cavmarl.driving.kernels.motion.steering import steer_to_lane
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.policy import Policy


class NeverYieldPolicy(Policy):
    """Follows the centre of its lanes, and neither brakes nor accelerates.

    It reads the world instead of observations, so the worlds must run in this process.
    """

    def __init__(self, env: CavEnv | CavVectorEnv) -> None:
        super().__init__(env)
        if env.config.action.kind != "continuous":
            raise PolicyError("never_yield steers: it needs action.kind = continuous")

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return (W, A, 2): no throttle, and steering along the lanes."""
        actions = np.zeros((*mask.shape, 2), dtype=np.float32)
        for world in range(len(mask)):
            for agent, steering in self._steerings(world).items():
                actions[world, agent, 1] = steering
        return actions

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the actions by agent."""
        if isinstance(self.env, CavVectorEnv):
            raise PolicyError("act() drives a parallel_env; a make_vec is driven by act_batch()")
        steerings = self._steerings(0)
        index = {agent: k for k, agent in enumerate(self.env.possible_agents)}
        return {
            agent: np.array([0.0, steerings[index[agent]]], dtype=np.float32)
            for agent in self.env.agents
        }

    def _steerings(self, world: int) -> dict[int, float]:
        """Return the steering by agent, from -1 to 1."""
        simulation, limit = self.env.simulation, self.env.config.action.steering_rad
        rows = simulation.vehicles(world)
        found = {}
        for row in rows[rows["agent"] >= 0]:
            angle = steer_to_lane(
                self.env.network.arrays,
                simulation.plans,
                row,
                int(row["lane"]),
                float(simulation.types["wheelbase"][row["vtype"]]),
            )
            found[int(row["agent"])] = min(max(angle / limit, -1.0), 1.0)
        return found


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Create a driver that never yields."""
    return NeverYieldPolicy(env)
