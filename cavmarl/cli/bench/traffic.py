"""`cavmarl bench traffic`: our traffic beside SUMO's on the same map and demand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import JsonPath, Seed, number, write_json
from cavmarl.core.errors import ConfigError, require

if TYPE_CHECKING:
    from cavmarl.bench.traffic_speed import TrafficSpeed
    from cavmarl.evaluate.traffic.traffic_comparison import TrafficComparison

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
        bool, typer.Option("--speed", help="Measure how fast both are, not what they do.")
    ] = False,
    after: Annotated[int, typer.Option(help="With --speed: simulated seconds before it.")] = 120,
    repeats: Annotated[int, typer.Option(help="With --speed: turns of 10 s of each.")] = 5,
    json_path: JsonPath = None,
) -> None:
    """Our traffic beside SUMO's own run: same map, demand, seed and step length."""
    from cavmarl.bench.traffic_speed import measure_traffic_speed
    from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic

    if speed and plot is not None:
        raise ConfigError("--plot: draws what both do, and --speed does not look; use one")
    if plot is not None:
        require("matplotlib", "report")
    console = Console()
    with console.status("") as status:
        found: TrafficComparison | TrafficSpeed
        tolerated: tuple[str, ...] = ()
        if speed:
            found = measure_traffic_speed(
                map_name,
                demand,
                dt_s=dt,
                seed=seed,
                after_s=after,
                repeats=repeats,
                progress=status.update,
            )
            table = _speeds(found)
        else:
            found = compare_traffic(
                map_name,
                demand,
                seconds=seconds,
                dt_s=dt,
                seed=seed,
                teleports=teleports,
                progress=status.update,
            )
            table, tolerated = _figures(found), found.tolerated
            if plot is not None:
                _draw(found, plot)
    console.print(table)
    if tolerated:
        console.print("tolerated in our reading of the demand:", *tolerated, sep="\n")
    write_json(json_path, found.to_dict())


def _draw(found: TrafficComparison, path: Path) -> None:
    from cavmarl.evaluate.traffic.traffic_plot import plot_fundamental_diagram

    plot_fundamental_diagram(found, path)


def _figures(found: TrafficComparison) -> Table:
    table = Table(
        "", title=f"{found.map_name}, {found.seconds} s, step {found.dt_s:g} s, seed {found.seed}"
    )
    for column in ("cavmarl", "SUMO", "ratio"):
        table.add_column(column, justify="right")
    for label, name in _ROWS.items():
        sides = (getattr(run.figures, name) for run in (found.ours, found.sumo))
        table.add_row(label, *map(_cell, sides), number(found.ratio(name)))
    return table


def _speeds(found: TrafficSpeed) -> Table:
    table = Table(
        "vehicle-steps/s",
        title=(
            f"{found.map_name}, step {found.dt_s:g} s, one core, {found.repeats} turns of each, "
            f"after {found.after_s} s"
        ),
        caption=f"ratio of the medians: {found.ratio:.1f}",
    )
    for column in ("vehicles", "min", "median", "max"):
        table.add_column(column, justify="right")
    for name, vehicles, rates in (
        ("cavmarl", found.our_vehicles, found.ours),
        ("libsumo", found.sumo_vehicles, found.sumo),
    ):
        values = (vehicles, rates.low, rates.median, rates.high)
        table.add_row(name, *(f"{value:,.0f}" for value in values))
    return table


def _cell(value: float | str | None) -> str:
    if isinstance(value, str):
        return value or "-"
    return f"{value:,}" if isinstance(value, int) else number(value)
