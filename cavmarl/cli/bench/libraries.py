"""`cavmarl bench libraries`: what each library's view of a world costs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import JsonPath, write_json
from cavmarl.core.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.bench.library_speed import LibrarySpeed

__all__ = ["libraries"]

_VIEWS = {
    "arrays": "cavmarl, arrays",
    "dicts": "PettingZoo, dicts",
    "gymnasium": "Gymnasium, rows",
    "sb3": "stable-baselines3, rows",
    "torchrl": "TorchRL",
    "torchrl_stock": "TorchRL's own wrapper of the dicts",
}


def libraries(
    env: Annotated[str, typer.Option(help="A name, a folder or a map file.")] = "town",
    agents: Annotated[int, typer.Option(help="Seats of the one world.")] = 1000,
    steps: Annotated[int, typer.Option(help="Steps of each view.")] = 30,
    at_most: Annotated[
        float | None, typer.Option(help="Exit with 1 if TorchRL's view adds more ms a step.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """What the libraries' views add to a step of the same world, in the processor's time."""
    from cavmarl.bench.library_speed import measure_library_speed

    if at_most is not None and not 0.0 < at_most < math.inf:
        raise ConfigError(f"--at-most {at_most:g}: must be a number above 0")
    console = Console()
    with console.status("") as status:
        found = measure_library_speed(env, agents, steps, status.update)
    console.print(_table(found))
    write_json(json_path, found.to_dict())
    added = next(row.added_ms for row in found.rows if row.view == "torchrl")
    if at_most is not None and (added is None or added > at_most):
        raise typer.Exit(1)


def _table(found: LibrarySpeed) -> Table:
    table = Table(
        "view",
        title=(
            f"a step of one world with {found.agents:,} agents, in ms of one core: "
            f"medians of {found.steps} steps"
        ),
    )
    for column in ("a step", "of it the view's"):
        table.add_column(column, justify="right")
    for row in found.rows:
        if row.step_ms is None or row.added_ms is None:
            table.add_row(_VIEWS[row.view], "not installed", "")
        else:
            added = "" if row.view == "arrays" else f"{row.added_ms:.2f}"
            table.add_row(_VIEWS[row.view], f"{row.step_ms:.2f}", added)
    return table
