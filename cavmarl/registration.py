"""The names under which other libraries find the environments.

PettingZoo: the module functions `parallel_env`, `env` and `raw_env`, and, from 1.27 on, ids such as
`cavmarl/merge-v0` in its registry. Gymnasium: `cavmarl/merge-v0`, one vehicle of the world as a
single-agent environment, and `cavmarl/mergeAgents-v0` for `gymnasium.make_vec`, all agents as rows.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import pettingzoo
from pettingzoo.utils import parallel_to_aec, wrappers
from pettingzoo.utils.env import AECEnv

from cavmarl.cav_env import parallel_env
from cavmarl.registry import entries

__all__ = ["env", "raw_env", "register_all"]

VERSION = 0  # of the ids; an entry whose decisions change gets a new one


def raw_env(name: str = "merge", **arguments: Any) -> AECEnv[str, Any, Any]:
    """The AEC form, without checks; arguments as for `parallel_env`."""
    return parallel_to_aec(parallel_env(name, **arguments))


def env(name: str = "merge", **arguments: Any) -> AECEnv[str, Any, Any]:
    """The AEC form: agents act one after the other and the world moves when all have."""
    return wrappers.OrderEnforcingWrapper(raw_env(name, **arguments))


def register_all() -> None:
    """Register every entry with Gymnasium and, where it has a registry, with PettingZoo."""
    for name in entries():
        one, rows = f"cavmarl/{name}-v{VERSION}", f"cavmarl/{name}Agents-v{VERSION}"
        gymnasium.register(
            one,
            entry_point="cavmarl.adapters.gymnasium_env:CavEgoEnv",
            kwargs={"env": name},
            disable_env_checker=True,
        )
        gymnasium.register(
            rows,
            vector_entry_point="cavmarl.adapters.gymnasium_env:CavAgentRows",
            kwargs={"env": name},
            disable_env_checker=True,
        )
        if hasattr(pettingzoo, "register"):
            pettingzoo.register(
                "parallel", one, "cavmarl.cav_env:parallel_env", kwargs={"env": name}
            )
