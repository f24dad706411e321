"""`cavmarl list`: lists environments and drivers."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import JsonPath, write_json
from cavmarl.config.registry import agent_entries, entries, load_config
from cavmarl.core.errors import ConfigError


def list_entries(json_path: JsonPath = None) -> None:
    """List the environments and drivers that have a name."""
    console = Console()
    environments = Table("environment", "agents", "others", "action", "what it is")
    names = {}
    for name, folder in entries().items():
        names[name] = str(folder)
        try:
            config, _ = load_config(folder)
        except ConfigError as error:
            environments.add_row(escape(name), "broken", "", "", escape(str(error)))
            continue
        population = config.population
        environments.add_row(
            escape(name),
            f"{population.agents} {population.mode}",
            str(population.background),
            config.action.kind,
            escape(sentence_about(folder)),
        )
    drivers = Table("driver", "kind", "what it is")
    paths = {}
    for name, path in agent_entries().items():
        drivers.add_row(escape(name), _kind(path), escape(sentence_about(path)))
        paths[name] = str(path)
    console.print(environments)
    console.print(drivers)
    write_json(json_path, {"environments": names, "drivers": paths})


def _kind(path: Path) -> str:
    return "scripted" if path.suffix == ".py" else "trained"


def sentence_about(path: Path) -> str:
    """Return the first sentence about an entry: of its README.md, or of a script's docstring.

    If there is none, return the path of the entry.
    """
    try:
        if path.suffix == ".py":
            text = ast.get_docstring(ast.parse(path.read_bytes())) or ""
        else:
            text = (path / "README.md").read_text(encoding="utf-8")
    except (OSError, ValueError, SyntaxError):
        return str(path)
    paragraphs = re.split(r"\n\s*\n", text.strip())
    prose = (part for part in paragraphs if part[:1].isalnum())
    words = " ".join(next(prose, str(path)).split())
    plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", words).replace("`", "")
    return re.split(r"(?<=[.])\s+(?=[A-Z])", plain)[0] if words else str(path)
