"""`cavmarl bench traffic`: our traffic beside SUMO's on the same map and demand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.bench.harness import make_table, measuring
from cavmarl.cli.bench.traffic_worlds import compare_worlds
from cavmarl.cli.output import (
    JsonPath,
    Seed,
    about,
    about_file,
    make_folder,
    number,
    write_json,
)
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
        str, typer.Argument(metavar="[MAP]", help="A map file, or an environment's name or folder.")
    ] = "",
    demand: Annotated[
        list[Path] | None,
        about("A .rou.xml, .add.xml or .sumocfg; may be repeated.", "--demand", "-d"),
    ] = None,
    seconds: Annotated[int, about("Simulated seconds, from the demand's beginning.")] = 900,
    dt: Annotated[float, about("Step length of both, in seconds.")] = 0.1,
    seed: Seed = 0,
    teleports: Annotated[bool, about("Let SUMO teleport vehicles that stand for too long.")] = True,
    plot: Annotated[
        Path | None, about_file("Draw the fundamental diagram here (.png, .svg, .pdf).")
    ] = None,
    speed: Annotated[
        bool, about("Measure how fast both are, not what they do.", "--speed")
    ] = False,
    after: Annotated[int, about("With --speed: simulated seconds before the first turn.")] = 120,
    repeats: Annotated[int, about("With --speed: turns of 10 simulated seconds of each side.")] = 5,
    worlds: Annotated[
        int | None, about("Draw so many worlds by chance and compare all; no MAP.")
    ] = None,
    first_seed: Annotated[int, about("With --worlds: the first one's seed.")] = 0,
    out: Annotated[
        Path, about("With --worlds: folder of the results; rows that are there stay.")
    ] = Path("traffic_worlds"),
    without: Annotated[
        list[str] | None, about("With --worlds: a feature to leave out; may be repeated.")
    ] = None,
    maps: Annotated[
        Path | None, about("With --worlds: folder of maps to cut; default: SUMO's own.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Our traffic beside SUMO's own run: same map, demand, seed and step length."""
    if worlds is not None:
        if map_name or demand or plot is not None or speed:
            raise ConfigError("--worlds: draws maps and demands itself; leave out MAP, -d, --plot")
        make_folder(out)
        chosen = tuple(without or ())
        compare_worlds(worlds, first_seed, out, seconds, dt, json_path, chosen, maps)
        return
    if not map_name or not demand:
        raise ConfigError("give a MAP and its --demand FILE, or --worlds N to draw both by chance")
    if speed and plot is not None:
        raise ConfigError("--plot: draws flow and density, which --speed does not measure; use one")
    if speed:
        _measure_speed(map_name, demand, dt, seed, after, repeats, json_path)
    else:
        _compare(map_name, demand, seconds, dt, seed, teleports, plot, json_path)


def _measure_speed(
    map_name: str,
    demand: list[Path],
    dt: float,
    seed: int,
    after: int,
    repeats: int,
    json_path: Path | None,
) -> None:
    from cavmarl.bench.traffic_speed import measure_traffic_speed

    console = Console()
    with measuring(console) as say:
        turns = {"after_s": after, "repeats": repeats}
        found = measure_traffic_speed(map_name, demand, dt_s=dt, seed=seed, progress=say, **turns)
    console.print(_speeds(found))
    write_json(json_path, found.to_dict())


def _compare(
    map_name: str,
    demand: list[Path],
    seconds: int,
    dt: float,
    seed: int,
    teleports: bool,
    plot: Path | None,
    json_path: Path | None,
) -> None:
    from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic
    from cavmarl.evaluate.traffic.traffic_plot import plot_fundamental_diagram

    if plot is not None:
        require("matplotlib", "report")
    console = Console()
    with measuring(console) as say:
        found = compare_traffic(
            map_name,
            demand,
            seconds=seconds,
            dt_s=dt,
            seed=seed,
            teleports=teleports,
            progress=say,
        )
        if plot is not None:
            plot_fundamental_diagram(found, plot)
    console.print(_figures(found))
    if found.tolerated:
        console.print("tolerated in our reading of the demand:", *found.tolerated, sep="\n")
    write_json(json_path, found.to_dict())


def _figures(found: TrafficComparison) -> Table:
    rows = []
    for label, name in _ROWS.items():
        sides = (getattr(run.figures, name) for run in (found.ours, found.sumo))
        rows.append((label, *map(_cell, sides), number(found.ratio(name))))
    title = f"{found.map_name}, {found.seconds} s, step {found.dt_s:g} s, seed {found.seed}"
    return make_table(title, ("", "cavmarl", "SUMO", "ratio"), rows)


def _speeds(found: TrafficSpeed) -> Table:
    rows = [
        (name, *(f"{value:,.0f}" for value in (vehicles, rates.low, rates.median, rates.high)))
        for name, vehicles, rates in (
            ("cavmarl", found.our_vehicles, found.ours),
            ("libsumo", found.sumo_vehicles, found.sumo),
        )
    ]
    title = f"{found.map_name}, step {found.dt_s:g} s, one core, {found.repeats} turns of each"
    heads = ("vehicle-steps/s", "vehicles", "min", "median", "max")
    ratio = f"ratio of the medians: {found.ratio:.1f}"
    return make_table(f"{title}, after {found.after_s} s", heads, rows, ratio)


def _cell(value: float | str | None) -> str:
    if isinstance(value, str):
        return value or "-"
    return f"{value:,}" if isinstance(value, int) else number(value)
