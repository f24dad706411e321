"""Check that commands in pages and in help texts exist and accept their options."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import cache
from typing import Any

import typer

from cavmarl.cli import app

USAGE: Any = typer.BadParameter.__base__  # errors of an invalid command line


def check_command(line: str) -> None:
    """Parse a command line, including the options of its command, without running it."""
    command = whole_command()
    context = command.make_context("cavmarl", [], resilient_parsing=True)
    words = shlex.split(line.replace("…", ""), comments=True)[1:]
    while hasattr(command, "get_command") and words and not words[0].startswith("-"):
        _, found, words = command.resolve_command(context, words)
        assert found is not None, line
        context = type(context)(found, parent=context, **found.context_settings)
        command = found
    check_options(command, words, context)


def check_options(command: Any, words: Sequence[str], context: Any = None) -> None:
    """Parse the options and arguments of a command, without running it."""
    context = context or command.make_context(command.name, [], resilient_parsing=True)
    try:
        _, left, _ = command.make_parser(context).parse_args([*words])
    except USAGE as error:
        if "requires an argument" not in str(error):  # pages may name an option with a value
            raise
        left = []
    assert not left or context.ignore_unknown_options, f"{command.name}: {left}"


@cache
def whole_command() -> Any:
    """Return the command `cavmarl` with all its subcommands."""
    return typer.main.get_command(app)
