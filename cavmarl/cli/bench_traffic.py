"""`cavmarl bench traffic`: our traffic beside SUMO's on the same map and demand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import JsonPath, Seed, number, write_json
from cavmarl.errors import require

if TYPE_CHECKING:
    from cavmarl.evaluate.traffic_comparison import TrafficComparison

__all__ = ["traffic"]

_ROWS = {
    "departed": "departed",
    "waiting": "waiting",
    "arrived": "arrived",
    "mean speed, m/s": "mean_speed_mps",
    "mean delay, s": "mean_delay_s",
    "queue at signals": "queue",
    "contacts": "contacts",
    "longest lock, s": "longest_lock_s",
    "locked junction": "locked_junction",
    "teleports": "teleports",
}


def traffic(
    map_name: Annotated[
        str, typer.Argument(metavar="MAP", help="A map file, or an environment's name or folder.")
    ],
    demand: Annotated[
        list[Path],
        typer.Option("--demand", "-d", help="A .rou.xml, .add.xml or .sumocfg; may be repeated."),
    ],
    seconds: Annotated[int, typer.Option(help="How long, from the demand's beginning.")] = 900,
    dt: Annotated[float, typer.Option(help="Step length of both, in seconds.")] = 0.1,
    seed: Seed = 0,
    teleports: Annotated[
        bool, typer.Option(help="Let SUMO put vehicles elsewhere that stand for too long.")
    ] = True,
    plot: Annotated[
        Path | None, typer.Option(help="Draw the fundamental diagram here (.png, .svg, .pdf).")
    ] = None,
    speed: Annotated[
        bool, typer.Option("--speed", help="Measure how fast both are instead of what they do.")
    ] = False,
    repeats: Annotated[int, typer.Option(help="With --speed: measurements, by turns.")] = 5,
    json_path: JsonPath = None,
) -> None:
    """Our traffic beside SUMO's own run: same map, demand, seed and step length."""
    from cavmarl.evaluate.traffic_comparison import compare_traffic

    if plot is not None:
        require("matplotlib", "plot")
    console = Console()
    with console.status("") as status:
        found = compare_traffic(
            map_name,
            demand,
            seconds=seconds,
            dt_s=dt,
            seed=seed,
            teleports=teleports,
            progress=status.update,
        )
    console.print(_table(found))
    if plot is not None:
        from cavmarl.evaluate.traffic_plot import plot_fundamental_diagram

        plot_fundamental_diagram(found, plot)
    write_json(json_path, found.to_dict())


def _table(found: TrafficComparison) -> Table:
    table = Table(
        "", title=f"{found.map_name}, {found.seconds} s, step {found.dt_s:g} s, seed {found.seed}"
    )
    for column in ("cavmarl", "SUMO", "ratio"):
        table.add_column(column, justify="right")
    for label, name in _ROWS.items():
        sides = (getattr(run.figures, name) for run in (found.ours, found.sumo))
        table.add_row(label, *map(_cell, sides), number(found.ratio(name)))
    return table


def _cell(value: float | str | None) -> str:
    if isinstance(value, str):
        return value or "-"
    return f"{value:,}" if isinstance(value, int) else number(value)
