"""The AEC forms of the environments under PettingZoo's names: `env` and `raw_env`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pettingzoo.utils import parallel_to_aec, wrappers
from pettingzoo.utils.env import AECEnv

from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.env.world_copies import OwnWorlds


class CheckedActions(OwnWorlds, wrappers.OrderEnforcingWrapper):  # type: ignore[misc] # not typed
    """The AEC form, which refuses a wrong action at once instead of when all agents have acted.

    Args:
        world: the parallel environment.
    """

    def __init__(self, world: CavEnv) -> None:
        super().__init__(parallel_to_aec(world))
        self._world = world

    def step(self, action: Any) -> None:
        """Let the selected agent act.

        Raises:
            ActionError: the shape, the dtype or a value is wrong; the agent can act again.
        """
        agent = self.agent_selection
        if action is not None and not (self.terminations[agent] or self.truncations[agent]):
            self._world.check_action(agent, action)
        super().step(action)


def raw_env(env: str | Path = "merge", **arguments: Any) -> AECEnv[str, Any, Any]:
    """Return the AEC form without checks; arguments as for `parallel_env`."""
    return parallel_to_aec(parallel_env(env, **arguments))


def env(env: str | Path = "merge", **arguments: Any) -> AECEnv[str, Any, Any]:
    """Return the AEC form: agents act one after another; the world advances when all have acted.

    Calls out of order and wrong actions are refused. Arguments as for `parallel_env`.
    """
    return CheckedActions(parallel_env(env, **arguments))
