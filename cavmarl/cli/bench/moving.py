"""`cavmarl bench moving`: what it brings that worlds may change their worker."""

from __future__ import annotations

import math
import statistics
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import JsonPath, Seed, Settings, parse_settings, write_json
from cavmarl.core.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.bench.moving_speed import MovingSpeed

__all__ = ["moving"]


def moving(
    env: Annotated[
        str,
        typer.Argument(metavar="[ENV]", help="Its map, with roads into it and out of it, is used."),
    ] = "grid4x4",
    worlds: Annotated[int, typer.Option(help="Stepped together.")] = 16,
    workers: Annotated[int, typer.Option(help="Over which they are shared out.")] = 2,
    lead: Annotated[int, typer.Option(help="Steps before half of them begin anew.")] = 600,
    every: Annotated[int, typer.Option(help="Steps from round to round.")] = 10,
    period: Annotated[float, typer.Option(help="Seconds between vehicles of a road.")] = 5.0,
    steps: Annotated[int, typer.Option(help="Of a turn.")] = 20,
    repeats: Annotated[int, typer.Option(help="Turns of each.")] = 7,
    seed: Seed = 0,
    settings: Settings = None,
    at_least: Annotated[
        float | None, typer.Option(help="Exit with 1 if moving is not so many times faster.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Worlds of unequal cost over workers: shared out by number, and moving by what they cost."""
    from cavmarl.bench.moving_speed import measure_moving

    if at_least is not None and not 0.0 < at_least < math.inf:
        raise ConfigError(f"--at-least {at_least:g}: must be a number above 0")
    console = Console()
    with console.status("") as status:
        found = measure_moving(
            env,
            worlds=worlds,
            workers=workers,
            lead=lead,
            every=every,
            period_s=period,
            steps=steps,
            repeats=repeats,
            seed=seed,
            overrides=parse_settings(settings),
            say=status.update,
        )
    write_json(json_path, found.to_dict())
    console.print(_table(found))
    console.print(
        f"moving over fixed: [bold]{found.ratio:.2f}[/], by the busiest worker's processor time "
        f"{found.processor_ratio:.2f}; the same states",
        highlight=False,
    )
    if workers > (found.hardware["usable_cores"] or workers):
        console.print("note: more workers than cores", style="yellow")
    if at_least is not None and found.ratio < at_least:
        raise typer.Exit(1)


def _table(found: MovingSpeed) -> Table:
    hardware = found.hardware
    old, young = found.vehicles[: found.old], found.vehicles[found.old :]
    table = Table(
        "worlds",
        title=escape(
            f"{found.env}: {found.worlds} worlds over {found.workers} workers; {len(old)} of "
            f"{statistics.fmean(old):.0f} vehicles, {len(young)} of {statistics.fmean(young):.0f}\n"
            f"{hardware['cpu']}, {hardware['usable_cores']} cores"
        ),
    )
    for column in ("step, ms: min", "median", "busiest, ms", "max / mean", "moves", "ms a move"):
        table.add_column(column, justify="right")
    for row in found.rows:
        table.add_row(
            row.name,
            f"{min(row.step_ms):.2f}",
            f"{statistics.median(row.step_ms):.2f}",
            f"{row.busiest_ms:.2f}",
            f"{row.imbalance:.2f}",
            str(row.moves),
            "-" if row.move_ms is None else f"{row.move_ms:.1f}",
        )
    return table
