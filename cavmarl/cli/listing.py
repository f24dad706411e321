"""`cavmarl list`: lists environments and drivers."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import JsonPath, write_json
from cavmarl.config.registry import agent_entries, entries, load_config


def list_entries(json_path: JsonPath = None) -> None:
    """Show the environments and the drivers that a name can mean."""
    console = Console()
    environments = Table("environment", "population", "background", "action", "folder")
    names = {}
    for name, folder in entries().items():
        config, _ = load_config(folder)
        population = config.population
        environments.add_row(
            name,
            f"{population.agents} {population.mode}",
            str(population.background),
            config.action.kind,
            _shown(folder),
        )
        names[name] = str(folder)
    drivers = Table("driver", "kind", "path")
    paths = {}
    for name, path in agent_entries().items():
        drivers.add_row(name, _kind(path), _shown(path))
        paths[name] = str(path)
    console.print(environments)
    console.print(drivers)
    write_json(json_path, {"environments": names, "drivers": paths})


def _kind(path: Path) -> str:
    return "scripted" if path.suffix == ".py" else "trained"


def _shown(path: Path) -> str:
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)
