"""`cavmarl train`: runs the training programs of `train/`, which the wheel carries."""

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
from cavmarl.core.errors import ConfigError


def train(
    name: Annotated[
        str | None, typer.Argument(metavar="PROGRAM", help="One of them; none: say what there is.")
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Argument(metavar="OPTIONS", help="Its own; --help shows them. --config takes names."),
    ] = None,
) -> None:
    """Train with one of the programs of `train/`: `cavmarl train ppo --config merge`."""
    known = programs()
    if name is None:
        shown = Table("program", "what it does")
        for each, path in known.items():
            shown.add_row(each, _first_line(path))
        Console().print(shown)
        return
    if name not in known:
        raise ConfigError(f"no training program {name!r}: there are {', '.join(known)}")
    command = [sys.executable, str(known[name]), *with_config(options or [])]
    os.execv(sys.executable, command)  # so that signals and the exit code are the program's own


def with_config(words: list[str]) -> list[str]:
    """The words, with the path of a file in `configs/train/` where `--config` has its name."""
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
    """Of the program's docstring; it is not run, as it may need what is not installed."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]
