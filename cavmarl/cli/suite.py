"""`cavmarl suite`: evaluates drivers on several maps with several numbers of agents."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.evaluate import report_cell
from cavmarl.cli.output import (
    OUTPUT,
    Episodes,
    Imports,
    JsonPath,
    Policies,
    Repeats,
    Seed,
    about,
    grid,
    make_folder,
    parse_settings,
    write_json,
)
from cavmarl.config.registry import find_settings
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.evaluate import EvaluationReport

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
    imports: Imports = None,
    out: Annotated[
        Path,
        about("Folder for the results, with one folder per world.", metavar="DIR", panel=OUTPUT),
    ] = Path("runs/suite"),
    json_path: JsonPath = None,
) -> None:
    """Evaluate drivers in every world of a suite.

    `cavmarl report` shows all results of one world.
    """
    from cavmarl.evaluate.suite import load_suite, run_suite, worlds_of

    loaded = load_suite(find_settings("suite", name))
    worlds = worlds_of(loaded, maps)
    make_folder(out)
    console = Console()
    places = {world.label: k for k, world in enumerate(worlds)}
    with counting(console, f"worlds of {name}") as told:
        reports = run_suite(
            loaded,
            worlds,
            policy or ["idm"],
            out,
            episodes=episodes,
            repeats=repeats,
            seed=seed,
            overrides=parse_settings(None, imports),
            began=lambda world: told(places[world.label], len(worlds)),
        )
    console.print(_table(reports))
    write_json(json_path, {label: found.to_dict() for label, found in reports.items()})


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
