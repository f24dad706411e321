"""`cavmarl bench traffic`: compares traffic with SUMO on the same map and demand."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from cavmarl.bench.harness import BenchmarkReport, Say, silent
from cavmarl.cli.output import (
    Seed,
    about,
    about_file,
    flag,
    number,
)
from cavmarl.core.errors import ConfigError, require
from cavmarl.core.xml_root import is_sumo_config

_ROWS = {
    "departed": "departed",
    "waiting": "waiting",
    "arrived": "arrived",
    "mean speed, m/s": "mean_speed_mps",
    "mean delay, s": "mean_delay_s",
    "queue at signals": "queue",
    "flow per lane, 1/h": "flow_per_h",
    "median headway, s": "median_headway_s",
    "contacts": "contacts",
    "contacts per 1,000 km": "contacts_per_1000_km",
    "longest lock, s": "longest_lock_s",
    "locked junction": "locked_junction",
    "teleports": "teleports",
}
_OF_MODELS = {
    "m/s": "mean_speed_mps",
    "flow": "flow_per_h",
    "headway": "median_headway_s",
    "contacts": "contacts",
    "per 1,000 km": "contacts_per_1000_km",
    "km": "distance_km",
}


def traffic(
    map_name: Annotated[
        str,
        typer.Argument(
            metavar="MAP", help="Map file, .sumocfg, or the name or folder of an environment."
        ),
    ],
    demand: Annotated[
        list[Path] | None,
        about(
            "Demand: a .rou.xml, .add.xml or .sumocfg file. Repeat it for more [default: MAP, if "
            "it is a .sumocfg].",
            "--demand",
            "-d",
            metavar="FILE",
        ),
    ] = None,
    models: Annotated[
        list[str] | None,
        about(
            "Without a demand: driver of generated vehicles, as in traffic.model (IDM, "
            "zoo:cities_ippo), or drivers with shares (zoo:cities_ippo=0.7,IDM=0.3). Repeat it to "
            "compare several drivers; SUMO gets the trips of the first driver.",
            "--model",
            metavar="DRIVER",
        ),
    ] = None,
    background: Annotated[
        int, about("With --model: number of generated vehicles.", metavar="N")
    ] = 100,
    seconds: Annotated[
        int, about("Simulated seconds, from the beginning of the demand.", metavar="S")
    ] = 900,
    dt: Annotated[float, about("Step length of both simulators in seconds.", metavar="S")] = 0.1,
    seed: Seed = 0,
    teleports: Annotated[bool, flag("Let SUMO teleport vehicles that wait too long.")] = True,
    plot: Annotated[
        Path | None,
        about_file("Draw the fundamental diagram to this file (.png, .svg, .pdf)."),
    ] = None,
    speed: Annotated[
        bool, flag("Compare the speed of the simulators instead of their traffic.", "--speed")
    ] = False,
    after: Annotated[
        int, about("With --speed: simulated seconds before the first measurement.", metavar="S")
    ] = 120,
    repeats: Annotated[
        int,
        about(
            "With --speed: number of measurements of each simulator, of 10 simulated seconds each.",
            metavar="N",
        ),
    ] = 5,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare traffic with SUMO, with the same map, demand, seed and step length."""
    if speed and plot is not None:
        raise ConfigError(
            "--plot and --speed: --plot draws flow and density, which --speed does not measure; "
            "use only one of the two"
        )
    if models:
        if demand or speed or plot is not None:
            raise ConfigError(
                "--model: the generator makes the vehicles; leave out --demand, --speed and --plot"
            )
        return _models(map_name, models, background, seconds, dt, seed, teleports, say)
    demand = demand or ([Path(map_name)] if is_sumo_config(Path(map_name)) else [])
    if speed:
        return _speed(map_name, demand, dt, seed, after, repeats, say)
    return _comparison(map_name, demand, seconds, dt, seed, teleports, plot, say)


def _speed(
    map_name: str, demand: list[Path], dt: float, seed: int, after: int, repeats: int, say: Say
) -> BenchmarkReport:
    from cavmarl.bench.traffic_speed import measure_traffic_speed

    turns = {"after_s": after, "repeats": repeats}
    found = measure_traffic_speed(map_name, demand, dt_s=dt, seed=seed, progress=say, **turns)
    title = f"{found.map_name}, step {found.dt_s:g} s, one core, {found.repeats} turns of each"
    return BenchmarkReport(
        f"{title}, after {found.after_s} s",
        {
            "vehicle-steps/s": "side",
            "vehicles": "vehicles:,.0f",
            "min": "low:,.0f",
            "median": "median:,.0f",
            "max": "high:,.0f",
        },
        [
            {"side": "cavmarl", "vehicles": found.our_vehicles, **asdict(found.ours)},
            {"side": "libsumo", "vehicles": found.sumo_vehicles, **asdict(found.sumo)},
        ],
        facts=asdict(found),
        caption=f"ratio of the medians: {found.ratio:.1f}",
    )


def _comparison(
    map_name: str,
    demand: list[Path],
    seconds: int,
    dt: float,
    seed: int,
    teleports: bool,
    plot: Path | None,
    say: Say,
) -> BenchmarkReport:
    from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic
    from cavmarl.evaluate.traffic.traffic_plot import plot_fundamental_diagram

    if plot is not None:
        require("matplotlib", "report")
    found = compare_traffic(
        map_name, demand, seconds=seconds, dt_s=dt, seed=seed, teleports=teleports, progress=say
    )
    if plot is not None:
        plot_fundamental_diagram(found, plot)
    rows = []
    for label, name in _ROWS.items():
        ours, sumo = (_cell(getattr(run.figures, name)) for run in (found.ours, found.sumo))
        ratio = number(found.ratio(name))
        rows.append({"figure": label, "cavmarl": ours, "SUMO": sumo, "ratio": ratio})
    notes = [escape(line) for line in found.tolerated]
    return BenchmarkReport(
        f"{found.map_name}, {found.seconds} s, step {found.dt_s:g} s, seed {found.seed}",
        {"": "figure", "cavmarl": "cavmarl", "SUMO": "SUMO", "ratio": "ratio"},
        rows,
        notes=["tolerated while reading the demand:", *notes] if notes else [],
        facts=found.to_dict(),
    )


def _models(
    map_name: str,
    models: list[str],
    background: int,
    seconds: int,
    dt: float,
    seed: int,
    teleports: bool,
    say: Say,
) -> BenchmarkReport:
    from cavmarl.evaluate.traffic.model_comparison import compare_models

    found = compare_models(
        map_name,
        [_model(text) for text in models],
        vehicles=background,
        seconds=seconds,
        dt_s=dt,
        seed=seed,
        teleports=teleports,
        progress=say,
    )
    rows = [
        {
            "driver": escape(side.name),
            **{label: _cell(getattr(side.figures, name)) for label, name in _OF_MODELS.items()},
            "removed": _cell(side.removed),
        }
        for side in found.sides
    ]
    return BenchmarkReport(
        f"{found.map_name}, {found.vehicles} vehicles, {found.seconds} s, step {found.dt_s:g} s, "
        f"seed {found.seed}",
        {label: label for label in ("driver", *_OF_MODELS, "removed")},
        rows,
        facts=found.to_dict(),
        caption="mean speed; flow: vehicles per hour and lane; headway: median time headway in s; "
        "contacts, also per 1,000 km of all vehicles",
    )


def _model(text: str) -> str | dict[str, float]:
    """Read a driver, or drivers with shares, as the option states them."""
    if "=" not in text:
        return text
    pairs = [part.rpartition("=") for part in text.split(",")]
    try:
        return {name.strip(): float(share) for name, _, share in pairs}
    except ValueError:
        raise ConfigError(
            f"--model {text}: write each driver with its share, as in zoo:cities_ippo=0.7,IDM=0.3"
        ) from None


def _cell(value: float | str | None) -> str:
    if isinstance(value, str):
        return escape(value) or "-"
    return f"{value:,}" if isinstance(value, int) else number(value)
