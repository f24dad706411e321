"""`cavmarl baseline`: compares random, built-in and trained drivers on a map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.markup import escape

from cavmarl.cli.evaluate import driver_cell
from cavmarl.cli.output import (
    PAGE_EXTRAS,
    Agents,
    Backend,
    Background,
    Imports,
    JsonPath,
    MapName,
    NewFolder,
    Seed,
    Workers,
    Zones,
    about,
    backend_text,
    grid,
    make_folder,
    parse_settings,
    results_folder,
    write_json,
)
from cavmarl.core.errors import require_all
from cavmarl.core.progress import progress_bar


def baseline(
    where: MapName,
    policy: Annotated[
        str, about("Trained driver: its name or folder.", "--policy", "-p", metavar="POLICY")
    ] = "cities_ippo",
    episodes: Annotated[
        int, about("Number of episodes of each driver.", "--episodes", "-n", metavar="N")
    ] = 6,
    agents: Agents = None,
    background: Background = None,
    seed: Seed = 0,
    zones: Zones = None,
    backend: Backend = None,
    workers: Workers = None,
    imports: Imports = None,
    out: NewFolder = None,
    json_path: JsonPath = None,
) -> None:
    """Compare drivers on a map, and write a page.

    Random actions, `idm` and a trained driver drive the same trips in traffic. To measure the cost
    of traffic, `idm` also drives alone.
    """
    require_all(PAGE_EXTRAS)
    from cavmarl.evaluate.baseline import baseline_drivers, figures, run_baseline, write_baseline

    folder = results_folder(out, "baseline", where)
    make_folder(folder)
    console = Console()
    with progress_bar(console) as bar:
        task = bar.add_task("")

        def show(driver: str, steps: int, most: int) -> None:
            bar.update(task, description=f"{driver} drives", completed=steps, total=most)

        found = run_baseline(
            where,
            folder,
            policy=policy,
            agents=agents,
            background=background,
            episodes=episodes,
            seed=seed,
            progress=show,
            overrides=parse_settings(None, imports),
            zones=zones,
            backend=backend_text(backend, workers),
        )
    drivers = baseline_drivers(found)
    rows = [
        (metric.title, *(driver_cell(metric, driver) for driver in drivers.values()))
        for metric in figures()
    ]
    counts = [str(one.trips) for part in found.values() for one in part.policies.values()]
    title = f"{Path(where).name}, {episodes} episodes, seed {seed}"
    caption = (
        "idm alone: without other vehicles, on other trips. Shares [Wilson's 95 %], means (SD)"
    )
    heads = ("", *map(escape, drivers))
    table = grid(heads, [("trips", *counts), *rows], escape(title), caption, wraps=True)
    console.print(table)
    write_baseline(folder, found, folder / "baseline.html")
    write_json(json_path, {part: report.to_dict() for part, report in found.items()})
    console.print(
        f"page: {folder / 'baseline.html'}", markup=False, highlight=False, soft_wrap=True
    )
