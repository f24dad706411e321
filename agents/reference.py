"""The reference stack: perception, localisation, planning and control from sensors and the map.

It needs the sensors of `cavmarl.stack.reference_rig` on its vehicle. Here it runs in the process of
the environment, from the same snapshots that `cavmarl follow` gets over a socket.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.cav_env import CavEnv
from cavmarl.errors import PolicyError
from cavmarl.followers.client import sight_of
from cavmarl.followers.driver import StackDriver
from cavmarl.followers.snapshots import Moment, take_snapshot, welcome_to
from cavmarl.policies import Policy
from cavmarl.vector_env import CavVectorEnv


class ReferencePolicy(Policy):
    """One stack an agent.

    Args:
        env: a world with the sensors that the stack needs.
    """

    env: CavEnv

    def __init__(self, env: CavEnv) -> None:
        super().__init__(env)
        self.driver = StackDriver(env.network, welcome_to(env, env.possible_agents, 0))
        self._episode = 0

    def reset(self, seed: int | None = None) -> None:
        """Forget all vehicles."""
        self._episode += 1

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Not possible: snapshots are those of one world."""
        raise PolicyError("reference drives a parallel_env, whose act() it has")

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Controls from what the sensors of each agent's vehicle have."""
        env = self.env
        tick = int(env.worlds.ticks()[0])
        moment = Moment(0, self._episode, tick, False)
        agents = [k for k, agent in enumerate(env.possible_agents) if agent in env.agents]
        controls = self.driver.drive(sight_of(*take_snapshot(env, agents, moment)))
        idle = np.zeros(2, dtype=np.float32)
        return {
            agent: np.asarray(controls[agent], dtype=np.float32) if agent in controls else idle
            for agent in env.agents
        }


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Seat the stack.

    Raises:
        PolicyError: many worlds.
        ConfigError: the environment has no GNSS, or meta-actions.
    """
    if isinstance(env, CavVectorEnv):
        raise PolicyError("reference drives a parallel_env, not a make_vec")
    return ReferencePolicy(env)
