"""Registers the environments in other libraries.

PettingZoo: the module functions `parallel_env`, `env` and `raw_env`, and, from version 1.27 on,
ids such as `cavmarl/merge-v6` in its two registries. Gymnasium: `cavmarl/merge-v6` is a
single-agent environment with one vehicle of the world, and `cavmarl/mergeAgents-v6`, for
`gymnasium.make_vec`, has all agents as rows. `cavmarl/mergeDiscrete-v6` and
`cavmarl/mergeDiscreteAgents-v6` use meta-actions. highway-env's tasks keep their names: `merge-v0`
is `cavmarl-highway/merge-v0`.
"""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium
import pettingzoo

from cavmarl.config.registry import entries

_ID = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


# Keys of `adapters/highway_tasks.py`, which is in a higher layer and slow to import.
HIGHWAY_TASKS = (
    "highway", "highway-fast", "merge", "roundabout", "intersection", "exit", "two-way", "u-turn",
)  # fmt: skip


def register_all() -> None:
    """Register every entry with Gymnasium and, if it has a registry, with PettingZoo.

    Also register highway-env's tasks with Gymnasium. An entry gets no id if its name is not valid
    in ids (letters, digits, `_`, `-` and `.`).
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
    for task in HIGHWAY_TASKS:
        gymnasium.register(
            f"cavmarl-highway/{task}-v0",
            entry_point="cavmarl.adapters.highway_env:HighwayEnv",
            kwargs={"task": task},
            disable_env_checker=True,
        )


def _version(folder: Path) -> int:
    """Return the entry's version, without the parsers that would slow down the import."""
    try:
        text = (folder / "env.yaml").read_bytes()
    except OSError:
        return 0  # loading the entry reports the error
    found = re.search(rb"^version: *(\d{1,9})", text, re.MULTILINE)
    return int(found[1]) if found else 0
