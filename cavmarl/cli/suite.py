"""`cavmarl suite`: evaluates drivers or signal controllers on several maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.evaluate import report_cell
from cavmarl.cli.output import (
    OUTPUT,
    Backend,
    Episodes,
    Imports,
    JsonPath,
    Policies,
    Repeats,
    Seed,
    Settings,
    Workers,
    Zones,
    about,
    backend_text,
    grid,
    make_folder,
    parse_settings,
    write_json,
)
from cavmarl.config.registry import find_settings
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.evaluate import EvaluationReport
    from cavmarl.evaluate.signals.signal_meter import SignalFigures

# Figures of signal controllers, and their names in tables.
SIGNAL_FIGURES = {
    "arrived": "arrived",
    "never_departed": "never departed",
    "delay_s": "delay, s",
    "delay_of_all_s": "delay of all, s",
    "trip_s": "trip, s",
    "waiting_s": "waiting, s",
    "stops": "stops",
    "queue": "queue",
    "most_queued": "longest queue",
    "co2_g_per_km": "CO₂, g/km",
    "switches_per_h": "switches/h",
    "longest_red_s": "longest red, s",
    "jams": "runs that jam",
}
SHOWN = ("success", "collision", "off_road", "delay_s")  # metrics that fit eighty columns


def suite(
    name: Annotated[
        str,
        typer.Argument(
            metavar="SUITE", help="Name of a suite in configs/suites/, or a .yaml file."
        ),
    ] = "tasks",
    maps: Annotated[Path, about("Folder of the map files.", metavar="DIR")] = Path("maps"),
    policy: Policies = None,
    episodes: Episodes = 4,
    repeats: Repeats = 5,
    seed: Seed = 0,
    zones: Zones = None,
    backend: Backend = None,
    workers: Workers = None,
    settings: Settings = None,
    imports: Imports = None,
    out: Annotated[
        Path,
        about("Folder for the results, with one folder per world.", metavar="DIR", panel=OUTPUT),
    ] = Path("runs/suite"),
    json_path: JsonPath = None,
) -> None:
    """Evaluate drivers, or signal controllers, in every world of a suite.

    `cavmarl report` shows all results of drivers in one world.
    """
    from cavmarl.evaluate.suite import left_out, load_suite, run_signals, run_suite, worlds_of

    loaded = load_suite(find_settings("suite", name))
    worlds = worlds_of(loaded, maps)
    console = Console()
    places = {world.label: k for k, world in enumerate(worlds)}
    if missing := left_out(loaded, maps):
        console.print(f"not in {maps}, left out: {', '.join(missing)}", highlight=False)
    if loaded.controllers is not None:
        if policy:
            raise ConfigError(
                f"--policy: the suite {name} evaluates signal controllers; leave it out"
            )
        if (zones, backend, workers) != (None, None, None):
            raise ConfigError(
                f"--zones, --backend and --workers: the suite {name} runs signal controllers in "
                "this process; leave these options out"
            )
        with counting(console, f"worlds of {name}") as told:
            figures = run_signals(
                loaded,
                worlds,
                repeats=repeats,
                seed=seed,
                overrides=parse_settings(settings, imports),
                began=lambda world: told(places[world.label], len(worlds)),
            )
        for label, found in figures.items():
            console.print(signal_table(label, found))
        write_json(json_path, _as_numbers(figures))
        return
    make_folder(out)
    with counting(console, f"worlds of {name}") as told:
        reports = run_suite(
            loaded,
            worlds,
            policy or ["idm"],
            out,
            episodes=episodes,
            repeats=repeats,
            seed=seed,
            overrides=parse_settings(settings, imports),
            zones=zones,
            backend=backend_text(backend, workers),
            began=lambda world: told(places[world.label], len(worlds)),
        )
    console.print(_table(reports))
    write_json(json_path, {label: found.to_dict() for label, found in reports.items()})


def signal_table(label: str, found: Mapping[str, Sequence[SignalFigures]]) -> Table:
    """Return a table of mean figures on one map, with the half width of their 95 % interval."""
    rows = [
        (title, *(_mean_cell(runs, name) for runs in found.values()))
        for name, title in SIGNAL_FIGURES.items()
    ]
    heads = (escape(label), *(name.replace("_", " ") for name in found))
    table = grid(heads, rows, wraps=True)
    table.columns[0].no_wrap = True
    return table


def _mean_cell(runs: Sequence[SignalFigures], name: str) -> str:
    from cavmarl.evaluate.statistics import mean_interval

    values = np.array([getattr(run, name) for run in runs], dtype=np.float64)
    if np.isnan(values).all():
        return "-"
    if name == "jams":
        return f"{values.sum():.0f} of {len(values)}"
    interval, mean = mean_interval(values), values.mean()
    half = 0.0 if interval is None else 0.5 * (interval.high - interval.low)
    digits = 1 if max(abs(mean), half) < 100.0 else 0
    spread = "" if interval is None else f"±{half:.{digits}f}"
    return f"{mean:.{digits}f}{spread}"


def _as_numbers(figures: Mapping[str, Mapping[str, Sequence[SignalFigures]]]) -> dict[str, Any]:
    return {
        label: {name: [asdict(run) for run in runs] for name, runs in found.items()}
        for label, found in figures.items()
    }


def _table(reports: dict[str, EvaluationReport]) -> Table:
    from cavmarl.evaluate.metrics import METRICS

    metrics = [metric for metric in METRICS if metric.name in SHOWN]
    rows = []
    for label, found in reports.items():
        for driver, results in found.policies.items():
            cells = (report_cell(metric, results[metric.name]) for metric in metrics)
            rows.append((escape(label), escape(Path(driver).name), *cells))
    heads = ("map, agents", "driver", *(metric.title for metric in metrics))
    return grid(heads, rows, lefts=2)
