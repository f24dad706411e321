"""`cavmarl bench traffic`: our traffic beside SUMO's on the same map and demand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.bench.harness import make_table, measuring
from cavmarl.cli.output import JsonPath, Seed, number, write_json
from cavmarl.core.errors import ConfigError, require

if TYPE_CHECKING:
    from cavmarl.bench.traffic_speed import TrafficSpeed
    from cavmarl.evaluate.traffic.traffic_comparison import TrafficComparison

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
    seconds: Annotated[
        int, typer.Option(help="Simulated seconds, from the demand's beginning.")
    ] = 900,
    dt: Annotated[float, typer.Option(help="Step length of both, in seconds.")] = 0.1,
    seed: Seed = 0,
    teleports: Annotated[
        bool, typer.Option(help="Let SUMO teleport vehicles that stand for too long.")
    ] = True,
    plot: Annotated[
        Path | None, typer.Option(help="Draw the fundamental diagram here (.png, .svg, .pdf).")
    ] = None,
    speed: Annotated[
        bool, typer.Option("--speed", help="Measure how fast both are, not what they do.")
    ] = False,
    after: Annotated[
        int, typer.Option(help="With --speed: simulated seconds before the first turn.")
    ] = 120,
    repeats: Annotated[
        int, typer.Option(help="With --speed: turns of 10 simulated seconds of each side.")
    ] = 5,
    json_path: JsonPath = None,
) -> None:
    """Our traffic beside SUMO's own run: same map, demand, seed and step length."""
    from cavmarl.bench.traffic_speed import measure_traffic_speed
    from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic

    if speed and plot is not None:
        raise ConfigError("--plot: draws flow and density, which --speed does not measure; use one")
    if plot is not None:
        require("matplotlib", "report")
    console = Console()
    with measuring(console) as say:
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
                progress=say,
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
                progress=say,
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
    rows = []
    for label, name in _ROWS.items():
        sides = (getattr(run.figures, name) for run in (found.ours, found.sumo))
        rows.append((label, *map(_cell, sides), number(found.ratio(name))))
    title = f"{found.map_name}, {found.seconds} s, step {found.dt_s:g} s, seed {found.seed}"
    return make_table(title, ("", "cavmarl", "SUMO", "ratio"), rows)


def _speeds(found: TrafficSpeed) -> Table:
    sides = (
        ("cavmarl", found.our_vehicles, found.ours),
        ("libsumo", found.sumo_vehicles, found.sumo),
    )
    rows = [
        (name, *(f"{value:,.0f}" for value in (vehicles, rates.low, rates.median, rates.high)))
        for name, vehicles, rates in sides
    ]
    return make_table(
        f"{found.map_name}, step {found.dt_s:g} s, one core, {found.repeats} turns of each, "
        f"after {found.after_s} s",
        ("vehicle-steps/s", "vehicles", "min", "median", "max"),
        rows,
        f"ratio of the medians: {found.ratio:.1f}",
    )


def _cell(value: float | str | None) -> str:
    if isinstance(value, str):
        return value or "-"
    return f"{value:,}" if isinstance(value, int) else number(value)
