"""The names under which other libraries find the environments.

PettingZoo: the module functions `parallel_env`, `env` and `raw_env`, and, from 1.27 on, ids such
as `cavmarl/merge-v1` in both its registries. Gymnasium: `cavmarl/merge-v1`, one vehicle of the
world as a single-agent environment, and `cavmarl/mergeAgents-v1` for `gymnasium.make_vec`, all
agents as rows; `cavmarl/mergeDiscrete-v1` and `cavmarl/mergeDiscreteAgents-v1` are the same with
meta-actions.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium
import pettingzoo
from pettingzoo.utils import parallel_to_aec, wrappers
from pettingzoo.utils.env import AECEnv

from cavmarl.config.registry import entries
from cavmarl.env.parallel import CavEnv, parallel_env

_ID = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


class CheckedActions(wrappers.OrderEnforcingWrapper):  # type: ignore[misc] # not typed
    """The AEC form that refuses a wrong action at once: kept for later, it would spoil the step.

    Args:
        world: the parallel environment.
    """

    def __init__(self, world: CavEnv) -> None:
        super().__init__(parallel_to_aec(world))
        self._world = world

    def step(self, action: Any) -> None:
        """Let the selected agent act.

        Raises:
            ActionError: wrong shape, dtype or value; the agent can act again.
        """
        agent = self.agent_selection
        if action is not None and not (self.terminations[agent] or self.truncations[agent]):
            self._world.check_action(agent, action)
        super().step(action)


def raw_env(env: str | Path = "merge", **arguments: Any) -> AECEnv[str, Any, Any]:
    """The AEC form, without checks; arguments as for `parallel_env`."""
    return parallel_to_aec(parallel_env(env, **arguments))


def env(env: str | Path = "merge", **arguments: Any) -> AECEnv[str, Any, Any]:
    """The AEC form: agents act one after the other and the world moves when all have.

    Calls out of order and wrong actions are refused. Arguments as for `parallel_env`.
    """
    return CheckedActions(parallel_env(env, **arguments))


def register_all() -> None:
    """Register every entry with Gymnasium and, where it has a registry, with PettingZoo.

    Entries whose name cannot be an id (letters, digits, `_`, `-` and `.`) have none.
    """
    for name, folder in entries().items():
        if not _ID.fullmatch(name):
            continue
        version = _version(folder)
        one = f"cavmarl/{name}-v{version}"
        for word, kind in {"": {}, "Discrete": {"action_kind": "discrete"}}.items():
            gymnasium.register(
                f"cavmarl/{name}{word}-v{version}",
                entry_point="cavmarl.adapters.gymnasium_env:CavEgoEnv",
                kwargs={"env": name, **kind},
                disable_env_checker=True,
            )
            gymnasium.register(
                f"cavmarl/{name}{word}Agents-v{version}",
                vector_entry_point="cavmarl.adapters.gymnasium_rows:CavAgentRows",
                kwargs={"env": name, **kind},
                disable_env_checker=True,
            )
        if hasattr(pettingzoo, "register"):
            of_entry = {"env": name}
            pettingzoo.register(
                "parallel", one, "cavmarl.env.parallel:parallel_env", kwargs=of_entry
            )
            pettingzoo.register("aec", one, "cavmarl.env.registration:env", kwargs=of_entry)


def _version(folder: Path) -> int:
    """The entry's version, read without the parsers that would make the import slow."""
    try:
        text = (folder / "env.yaml").read_bytes()
    except OSError:
        return 0  # what is wrong with it is said when it is used
    found = re.search(rb"^version: *(\d{1,9})", text, re.MULTILINE)
    return int(found[1]) if found else 0
