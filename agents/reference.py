"""The reference stack: perception, localisation, planning and control from sensors and the map.

It needs the sensors of `cavmarl.cosim.stack.stack` on its vehicle. It runs in the process of the
environment, on the same snapshots that `cavmarl follow` gets over a socket.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.followers.follower_client import sight_of
from cavmarl.cosim.followers.follower_driver import StackDriver
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, take_snapshot, welcome_to
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.policy import Policy


class ReferencePolicy(Policy):
    """One stack per agent.

    Args:
        env: environment in this process, with the sensors that the stack needs.
    """

    def __init__(self, env: CavEnv | CavVectorEnv) -> None:
        super().__init__(env)
        num_worlds = len(env.worlds.arrays.mask)
        welcome = welcome_to(env, env.possible_agents, 0)
        self.drivers = [StackDriver(env.network, welcome) for _ in range(num_worlds)]
        self._episodes = np.zeros(num_worlds, dtype=np.int64)
        self._ticks = np.zeros(num_worlds, dtype=np.int64)

    def reset(self, seed: int | None = None) -> None:
        """Forget all vehicles."""
        self._episodes += 1

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return controls (W, A, 2) from the sensor data of each vehicle."""
        actions = np.zeros((*mask.shape, 2), dtype=np.float32)
        ticks = self.env.worlds.ticks()
        self._episodes[ticks < self._ticks] += 1
        self._ticks = ticks
        for world, driver in enumerate(self.drivers):
            moment = SnapshotTime(0, int(self._episodes[world]), int(ticks[world]), False)
            agents = np.flatnonzero(mask[world]).tolist()
            sight = sight_of(*take_snapshot(self.env, agents, moment, world))
            for agent, controls in driver.drive(sight).items():
                actions[world, self.env.possible_agents.index(agent)] = controls
        return actions

    def act(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the controls of the agents in the world."""
        mask = self.env.worlds.arrays.mask
        actions = self.act_batch(np.zeros((*mask.shape, 0), dtype=np.float32), mask)[0]
        index = {agent: k for k, agent in enumerate(self.env.possible_agents)}
        live = self.env.agents if isinstance(self.env, CavEnv) else self.env.possible_agents
        return {agent: actions[index[agent]] for agent in live}


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Create the stack.

    Raises:
        ConfigError: the environment has no GNSS, or uses meta-actions.
    """
    return ReferencePolicy(env)
