"""Settings of a training job: what a client may choose, and the options of the program.

A job names no code and no files except those of its configuration: the node has the program.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from cavmarl.config.registry import programs
from cavmarl.service.configuration_files import placed_policies
from cavmarl.service.configurations import check_policies, world_of
from cavmarl.service.error_names import problem

PROGRAM = "ppo"  # the program of all training jobs
CAPABILITY = "train"  # of nodes that accept training jobs
RUN = Path("runs/training")  # folder of the run, in the working directory of the program
OF_CONFIGURATION = frozenset("env agents background num_envs settings zones seed".split())
OF_NODE = frozenset("plugins backend workers runs name resume loggers".split())
DRIVERS = ("start", "imitate", "opponents")  # settings that name drivers, comma-separated
_PLAIN = re.compile(r"[A-Za-z0-9_:, -]{0,200}")

Settings = Mapping[str, bool | int | float | str]


def check_training(document: Mapping[str, Any], settings: Settings) -> None:
    """Check a training job.

    Args:
        document: the configuration of its worlds.
        settings: the settings of the program that differ from their defaults.

    Raises:
        ServiceError: the configuration or a setting is not allowed.
    """
    for key, is_wrong, cure in (
        ("nodes", document.get("nodes"), "a training runs on one node; remove the key"),
        ("agents", document["agents"] == 0, "a training needs agents; give at least 1"),
        ("max_cycles", document["max_cycles"], "give horizon_s in the overrides instead"),
    ):
        if is_wrong:
            raise problem("refused", f"{key}: {document[key]}: {cure}")
    known = _setting_names() - OF_CONFIGURATION - OF_NODE
    for name, value in settings.items():
        if name in OF_CONFIGURATION:
            raise problem("refused", f"settings: {name} belongs to the configuration; remove it")
        if name in OF_NODE:
            raise problem("refused", f"settings: {name} is chosen by the node; remove it")
        if name not in known:
            there = ", ".join(sorted(known))
            raise problem("refused", f"settings: {name} is unknown; known settings: {there}")
        if isinstance(value, str) and not _PLAIN.fullmatch(value):
            raise problem(
                "refused",
                f"settings: {name}: {value[:64]!r} could name a file; use only letters, digits, "
                "_, -, : and commas",
            )
        if name in DRIVERS:
            check_policies(_names(value), document.get("files"))


def program_options(document: Mapping[str, Any], settings: Settings, work: Path) -> list[str]:
    """Return the options of the program; paths are relative to its working directory.

    `work`: the working directory, with the files of the configuration.
    """
    environment, keys = world_of(dict(document), str(work), ".")
    overrides = keys["overrides"].items()
    given: dict[str, Any] = {
        **settings,
        "env": environment,
        "num_envs": document["num_envs"],
        "seed": document["seed"],
        "settings": ",".join(f"{key}={json.dumps(value)}" for key, value in overrides),
        "runs": RUN.parent,
        "name": RUN.name,
    }
    given |= {key: keys[key] for key in ("agents", "background") if keys[key] is not None}
    for name in DRIVERS:
        if name in settings:
            placed = placed_policies(_names(settings[name]), document.get("files", {}), ".")
            given[name] = ",".join(placed)
    return [_option(name, value) for name, value in given.items()]


def _option(name: str, value: Any) -> str:
    option = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{option}" if value else f"--no-{option}"
    return f"--{option}={value}"


def _names(value: Any) -> list[str]:
    return [word for word in str(value).split(",") if word]


@cache
def _setting_names() -> frozenset[str]:
    """Return the names of the program's settings, without importing the program."""
    tree = ast.parse(programs()[PROGRAM].read_text(encoding="utf-8"))
    (kind,) = (one for one in tree.body if isinstance(one, ast.ClassDef) and one.name == "Args")
    named = (one.target for one in kind.body if isinstance(one, ast.AnnAssign))
    return frozenset(one.id for one in named if isinstance(one, ast.Name)) - {"program"}
