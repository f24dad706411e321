"""Error messages suggest only commands and options that exist."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
import typer

import cavmarl
from cavmarl.cli import app

PACKAGE = Path(cavmarl.__file__).parent
# Options of other programs: netconvert, Ray, gdal_calc.py.
FOREIGN = {"--keep-edges", "--junctions", "--address", "--head", "--calc", "--nproc-per-node"}
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
_COMMAND = re.compile(r"`(?:python -m )?cavmarl ([a-z-]+)(?: ([a-z-]+))?([^`]*)`")


def _commands(command: Any, path: str = "") -> Iterator[tuple[str, set[str]]]:
    yield path, {name for parameter in command.params for name in parameter.opts}
    if hasattr(command, "list_commands"):
        context = click.Context(command)
        for name in command.list_commands(context):
            yield from _commands(command.get_command(context, name), f"{path} {name}".strip())


COMMANDS = dict(_commands(typer.main.get_command(app)))


@pytest.fixture(scope="module")
def errors() -> list[tuple[str, str]]:
    """Return the place and the message of each error, with `{}` for inserted values."""
    return [
        (f"{path.relative_to(PACKAGE)}:{node.lineno}", _text(node.exc))
        for path in sorted(PACKAGE.rglob("*.py"))
        if "raise " in (text := path.read_text("utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Raise) and node.exc is not None
    ]


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.FormattedValue):
        return "{}"
    return "".join(map(_text, ast.iter_child_nodes(node)))


def test_each_suggested_command_exists_with_its_options(errors: list[tuple[str, str]]) -> None:
    found = 0
    for place, text in errors:
        for first, second, rest in _COMMAND.findall(text):
            name = f"{first} {second}" if f"{first} {second}" in COMMANDS else first
            assert name in COMMANDS, f"{place}: there is no command '{name}'"
            unknown = set(_OPTION.findall(rest)) - COMMANDS[name]
            assert not unknown, f"{place}: '{name}' has no {unknown}"
            found += 1
    assert found > 5


def test_each_suggested_option_belongs_to_a_command_or_a_program(
    errors: list[tuple[str, str]],
) -> None:
    programs = "".join(path.read_text("utf-8") for path in (PACKAGE / "learning").glob("*.py"))
    programs += "".join(path.read_text("utf-8") for path in (PACKAGE.parent / "train").glob("*.py"))
    known = set().union(*COMMANDS.values(), FOREIGN)
    found = 0
    for place, text in errors:
        for option in _OPTION.findall(text):
            setting = option[2:].replace("-", "_")
            is_setting = re.search(rf"^    {setting}: ", programs, re.MULTILINE)
            assert option in known or is_setting, f"{place}: no command or program has {option}"
            found += 1
    assert found > 50


def test_each_suggested_environment_variable_is_read(errors: list[tuple[str, str]]) -> None:
    texts = [path.read_text("utf-8") for path in PACKAGE.rglob("*.py")]
    variables = set(re.findall(r"CAVMARL_[A-Z_]+", str(errors)))
    assert variables
    for variable in sorted(variables):
        read = re.compile(rf"(environ[^\n]*|^_?[A-Z_]+ = )\"{variable}\"", re.MULTILINE)
        assert any(map(read.search, texts)), f"nothing reads {variable}"
