"""`cavmarl list`: lists environments and drivers."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import JsonPath, write_json
from cavmarl.config.entry_cards import sentence_about
from cavmarl.config.registry import agent_entries, entries, load_config
from cavmarl.core.errors import ConfigError


def list_entries(json_path: JsonPath = None) -> None:
    """List the environments and drivers that have a name."""
    console = Console()
    environments = Table("environment", "agents", "others", "action", "description")
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
    drivers = Table("driver", "kind", "description")
    paths = {}
    for name, path in agent_entries().items():
        drivers.add_row(escape(name), _kind(path), escape(sentence_about(path)))
        paths[name] = str(path)
    console.print(environments)
    console.print(drivers)
    write_json(json_path, {"environments": names, "drivers": paths})


def _kind(path: Path) -> str:
    return "scripted" if path.suffix == ".py" else "trained"
