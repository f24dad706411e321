"""`cavmarl train`: runs a training program of `train/`, which is part of the wheel."""

from __future__ import annotations

import ast
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.config.registry import find_settings, programs
from cavmarl.core.errors import ConfigError, require_all

EXTRAS = {  # optional modules of training programs
    "torch": "train",
    "stable_baselines3": "train",
    "tensordict": "torchrl",
    "torchrl": "torchrl",
    "benchmarl": "benchmarl",
    "ray": "rllib",
}


def train(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="PROGRAM", help="Name of a program; without a name, list the programs."
        ),
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="OPTIONS",
            help="Options of the program; `cavmarl train NAME --help` shows them.",
        ),
    ] = None,
) -> None:
    """Train a driver, for example with `cavmarl train ppo --config merge`."""
    known = programs()
    if name is None:
        shown = Table("program", "what it does")
        for each, path in known.items():
            shown.add_row(each, _first_line(path))
        Console().print(shown)
        return
    if name not in known:
        raise ConfigError(
            f"there is no training program {name!r}: choose one of {', '.join(known)}"
        )
    require_all(extras_of(known[name]))
    command = [sys.executable, str(known[name]), *with_config(options or [])]
    os.execv(sys.executable, command)  # the program then gets all signals, and sets the exit code


def extras_of(program: Path) -> dict[str, str]:
    """Return the optional modules that a program imports, with their extras."""
    extras = {}
    for node in ast.parse(program.read_text(encoding="utf-8")).body:
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for name in names:
            if (module := name.partition(".")[0]) in EXTRAS:
                extras[module] = EXTRAS[module]
    return extras


def with_config(words: list[str]) -> list[str]:
    """Return the words with names after `--config` replaced by paths in `configs/train/`."""
    found = [
        f"--config={find_settings('train', word.removeprefix('--config='))}"
        if word.startswith("--config=")
        else word
        for word in words
    ]
    for k, word in enumerate(words[:-1]):
        if word == "--config":
            found[k + 1] = str(find_settings("train", words[k + 1]))
    return found


def _first_line(path: Path) -> str:
    """Return the first line of the program's docstring, without importing the program."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]
