"""`cavmarl bench recut`: what it brings that zones may become others while a world runs."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import JsonPath, Settings, parse_settings, write_json

if TYPE_CHECKING:
    from cavmarl.bench.recut_speed import RecutSpeed

__all__ = ["recut"]


def recut(
    env: Annotated[str, typer.Argument(metavar="[ENV]", help="An entry, a folder or a map.")] = (
        "rush"
    ),
    zones: Annotated[int, typer.Option(help="How many.")] = 4,
    every: Annotated[int, typer.Option(help="Steps from look to look.")] = 20,
    steps: Annotated[int, typer.Option(help="Of each seed.")] = 300,
    seeds: Annotated[int, typer.Option(help="Worlds, one after the other.")] = 5,
    settings: Settings = None,
    json_path: JsonPath = None,
) -> None:
    """A world whose zones stay beside one whose zones become others: evenness, and its price."""
    from cavmarl.bench.recut_speed import measure_recutting

    console = Console()
    with console.status("") as status:
        found = measure_recutting(
            env,
            zones=zones,
            every=every,
            steps=steps,
            seeds=seeds,
            overrides=parse_settings(settings),
            say=status.update,
        )
    write_json(json_path, found.to_dict())
    console.print(_table(found))
    told = found.to_dict()
    interval = told["ratio95"]
    between = "" if interval is None else f" [{interval['low']:.2f}, {interval['high']:.2f}]"
    console.print(
        f"re-cut over static, fullest zone over mean: [bold]{told['ratio']:.2f}[/]"
        f"{escape(between)}; the same states",
        highlight=False,
    )


def _table(found: RecutSpeed) -> Table:
    hardware = found.hardware
    table = Table(
        "zones",
        title=escape(
            f"{found.env}: {found.zones} zones, {found.vehicles:.0f} vehicles\n"
            f"{hardware['cpu']}, {hardware['usable_cores']} cores"
        ),
    )
    for column in ("max / mean", "95 % between seeds", "step, ms", "re-cuts", "moved", "ms each"):
        table.add_column(column, justify="right")
    for row in found.rows:
        interval = row.imbalance95
        table.add_row(
            row.name,
            f"{statistics.fmean(row.imbalance):.2f}",
            "-" if interval is None else f"{interval.low:.2f} to {interval.high:.2f}",
            f"{statistics.median(row.step_ms):.2f}",
            str(row.recuts),
            str(row.moved),
            "-" if row.recut_ms is None else f"{row.recut_ms:.1f}",
        )
    return table
