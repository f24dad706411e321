"""`cavmarl evaluate`: evaluates drivers in seeded runs."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import (
    OUTPUT,
    PAGE,
    PAGE_EXTRAS,
    RECORD_EXTRAS,
    WEB_EXTRAS,
    Backend,
    Episodes,
    JsonPath,
    Policies,
    RecordAlso,
    RecordPath,
    Repeats,
    Workers,
    Zones,
    about,
    about_file,
    backend_text,
    check_extras,
    flag,
    grid,
    make_folder,
    number,
    recorded,
    with_world,
    write_json,
)
from cavmarl.cli.web import WebPort, say
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.errors import require_all
from cavmarl.core.progress import progress_bar
from cavmarl.viewer.web_options import DEFAULT_PORT, WebOptions

if TYPE_CHECKING:
    from cavmarl.env.vector import CavVectorEnv
    from cavmarl.evaluate import EvaluationReport
    from cavmarl.evaluate.metrics import Metric
    from cavmarl.evaluate.report import Found, PairedDifference, PolicyReport
    from cavmarl.ownership.transfer_summary import TransferSummary

HtmlPath = Annotated[
    Path | None,
    about_file("Write a page with tables, plots and the map to this file.", "--html"),
]


@with_world()
def evaluate(
    world: WorldSpec,
    policy: Policies = None,
    episodes: Episodes = 32,
    repeats: Repeats = 1,
    zones: Zones = None,
    backend: Backend = None,
    workers: Workers = None,
    out: Annotated[
        Path | None,
        about(
            "Folder for the manifest and the raw results [default: a new folder in runs/].",
            metavar="DIR",
            panel=OUTPUT,
        ),
    ] = None,
    record: RecordPath = None,
    record_also: RecordAlso = "",
    failures: Annotated[
        int,
        about(
            "Write the N worst trips, with replays, to failures.html.", metavar="N", panel=OUTPUT
        ),
    ] = 0,
    html: HtmlPath = None,
    page: Annotated[
        bool,
        flag("Serve a page that shows the episodes while they run.", panel=PAGE),
    ] = False,
    port: WebPort = DEFAULT_PORT,
    json_path: JsonPath = None,
) -> None:
    """Evaluate drivers in seeded episodes.

    The report shows success, safety, comfort, delay, throughput and fairness.
    """
    drivers = policy or ["idm"]
    check_extras(
        world, drivers, (html, PAGE_EXTRAS), (failures, {"jinja2": "report"}),
        (page, WEB_EXTRAS), (record, RECORD_EXTRAS),
    )  # fmt: skip
    _check_page(html)
    console = Console()
    # This call may print, so it comes before the progress bar.
    world = with_sensors_of_drivers(world, drivers)
    folder = out or _new_folder(world.env)
    more: dict[str, Any] = {
        "episodes": episodes,
        "repeats": repeats,
        "record": recorded(record, record_also),
        "failures": failures,
        "zones": zones,
        "backend": backend_text(backend, workers),
    }
    with ExitStack() as stack:
        if page:
            more["watcher"] = partial(_watched, stack, WebOptions(port=port, control=False))
        found = evaluate_showing(console, world, drivers, out=folder, **more)
    if failures:
        console.print(f"failed trips: {folder / 'failures.html'}", markup=False)
    _show(console, found, folder, html, json_path)


def _watched(stack: ExitStack, options: WebOptions, vec: CavVectorEnv) -> Callable[[], None]:
    """Serve a page of an evaluation until `stack` closes; return the function to call per step."""
    from cavmarl.viewer.live_env import ShownEnv

    shown = ShownEnv(vec, options, title="evaluation", looks_itself=False, tell=say)
    stack.callback(shown.close)
    return shown.look


def report(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Results folder of `cavmarl evaluate`.")
    ],
    html: HtmlPath = None,
    json_path: JsonPath = None,
) -> None:
    """Show the results of an evaluation again.

    The folder must contain the complete manifest of a finished evaluation.
    """
    from cavmarl.evaluate import load_report

    _check_page(html)
    _show(Console(), load_report(folder), folder, html, json_path)


def evaluate_showing(
    console: Console, world: WorldSpec, policies: Any, *, out: Path, **counts: Any
) -> EvaluationReport:
    """Run `cavmarl.evaluate.evaluate` with a progress bar."""
    from cavmarl.evaluate import evaluate as run

    with progress_bar(console) as bar:
        task = bar.add_task(world.env)

        def progress(policy: str, steps: int, most: int) -> None:
            what = f"{policy} drives {world.env}"
            bar.update(task, description=what, completed=steps, total=most)

        return run(world, policies, out=out, progress=progress, **counts)


def report_table(found: EvaluationReport) -> Table:
    """Return a table of all metrics with one column per driver."""
    drivers = found.policies.values()
    rows = [["trips", *(str(driver.trips) for driver in drivers)]]
    rows += _metric_rows(lambda metric: [driver_cell(metric, driver) for driver in drivers])
    rows += _transfer_rows([driver.transfers for driver in drivers])
    rows.append(["world step, ms", *(_least(driver, "step_ms") for driver in drivers)])
    rows.append(["policy, ms", *(_least(driver, "policy_ms") for driver in drivers)])
    uneven = [
        [run.zone_time_imbalance for run in driver.speed if run.zone_time_imbalance is not None]
        for driver in drivers
    ]
    if all(uneven):
        means = (f"{statistics.fmean(runs):.2f}" for runs in uneven)
        rows.append(["time of zones, max / mean", *means])
    world = found.manifest["world"]["environment"]
    runs = f"{found.repeats} runs of " if found.repeats > 1 else ""
    title = f"{world}, {runs}{found.episodes} episodes, seed {found.seeds[0]}"
    # Three drivers fit into eighty columns.
    return grid(_heads(found.policies), rows, escape(title), _caption(found.repeats), wraps=True)


def difference_table(found: EvaluationReport) -> Table:
    """Return a table of differences to the first driver, paired by episode."""
    first, *others = found.policies
    rows = _metric_rows(
        lambda metric: [_change(metric, found[name].minus_first[metric.name]) for name in others]
    )
    title = escape(f"minus {Path(first).name}, paired by seed")
    caption = "mean of the runs ± 95 % interval between runs; *: 0 lies outside"
    return grid(_heads(others), rows, title, caption, wraps=True)


def place_table(policy: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of incidents near zone borders and inside zones, to reveal border effects."""
    events, means = ("collision", "off_road", "red_light"), ("jerk", "ttc_risk")
    keys = ["agent_hours", *(f"{event}_per_h" for event in events), *means]
    heads = ["zone", "hours", "collisions/h", "off road/h", "red lights/h", "jerk", "ttc risk"]
    lines = [
        [
            f"{'all' if row['zone'] < 0 else row['zone']}, {row['place']}",
            *(number(row[key]) for key in keys),
        ]
        for row in rows
    ]
    return grid(heads, lines, escape(f"{Path(policy).name} near borders and inside"), wraps=True)


def resource_table(policy: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of the processor time, memory and messages of each process of a run."""
    heads = ["process", "CPU, %", "MB", "wait, %", "kB/tick", "frames/tick", "slowest, %", "moved"]
    lines = [
        [
            str(row["process"]),
            number(row["cpu_share"], 100.0),
            number(row["memory_mb"]),
            number(row["wait_share"], 100.0),
            number(row["bytes_per_tick"], 1e-3),
            number(row["frames_per_tick"]),
            number(row["straggler_share"], 100.0),
            number(row["migrations"]),
        ]
        for row in rows
    ]
    title = escape(f"processes of {Path(policy).name}, {rows[0]['windows']} windows")
    return grid(heads, lines, title, "-: not measured; moved: vehicles between zones", wraps=True)


def map_table(policy: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of a driver's results on each map, worst first."""
    from cavmarl.evaluate.map_table import SHOWN
    from cavmarl.evaluate.metrics import METRICS

    shown = [metric for metric in METRICS if metric.name in SHOWN]
    heads = ["map", "trips", *(metric.title for metric in shown)]
    lines = [
        [
            escape(row["map"]),
            str(row["trips"]),
            *(number(row[metric.name], metric.scale) for metric in shown),
        ]
        for row in rows
    ]
    return grid(heads, lines, escape(f"{Path(policy).name} by map, the worst first"), wraps=True)


def _heads(names: Iterable[str]) -> list[str]:
    return ["", *(escape(Path(name).name) for name in names)]


def _metric_rows(cells_of: Callable[[Metric], list[str]]) -> Iterator[list[str]]:
    """Yield title and cells of each metric that has values, except for terms of the reward."""
    from cavmarl.evaluate.metrics import METRICS

    for metric in METRICS:
        cells = cells_of(metric)
        if not metric.name.startswith("reward_") and set(cells) != {number(None)}:
            yield [metric.title, *cells]


def _transfer_rows(found: Sequence[TransferSummary | None]) -> Iterator[list[str]]:
    """Yield title and cells of the transfer statistics; undivided worlds have none."""
    summaries = [summary for summary in found if summary is not None]
    if not summaries:
        return
    yield ["transfers, forced", *(f"{each.transfers}, {each.forced}" for each in summaries)]
    for title, spreads in (
        ("transfer p50, p95, max, ticks", [each.latency_ticks for each in summaries]),
        ("transfer p50, p95, max, ms", [each.latency_ms for each in summaries]),
    ):
        yield [title, *(", ".join(map(number, spread)) for spread in spreads)]


def _show(
    console: Console,
    found: EvaluationReport,
    folder: Path,
    html: Path | None,
    json_path: Path | None,
) -> None:
    plain: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
    console.print(report_table(found))
    if len(found.policies) > 1:
        console.print(difference_table(found))
    for name, of_maps in found.by_map.items():
        console.print(map_table(name, of_maps))
    for name, used in found.resources.items():
        console.print(resource_table(name, used))
    from cavmarl.evaluate.evaluation import load_places

    for name, rows in load_places(folder).items():
        console.print(place_table(name, rows))
    write_json(json_path, found.to_dict())
    if html is not None:
        from cavmarl.evaluate.page import write_page

        write_page(folder, html)
        console.print(f"page: {html}", **plain)
    console.print(f"results: {folder} (`cavmarl report` shows them again)", **plain)


def _new_folder(env: str) -> Path:
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S-%f")
    return Path("runs/evaluate") / f"{Path(env).name}-{stamp}"


def _check_page(html: Path | None) -> None:
    """Raise an error before the evaluation starts if the page cannot be written."""
    if html is None:
        return
    require_all(PAGE_EXTRAS)
    make_folder(html.parent)


def _caption(repeats: int) -> str:
    if repeats > 1:
        return "mean of the runs, 95 % interval between runs (± or two limits), (SD within a run)"
    return "shares [Wilson's 95 %], means (SD within the run); one run: no interval of means"


def driver_cell(metric: Metric, driver: PolicyReport) -> str:
    """Return `report_cell` of a driver, with `>` in front of a lower bound."""
    return ("> " if driver.is_above(metric) else "") + report_cell(metric, driver[metric.name])


def report_cell(metric: Metric, found: Found) -> str:
    """Return mean, interval (between runs, or Wilson's) and SD within a run as a text."""
    if found.mean is None:
        return number(None)
    parts = [_figure(metric.scale * found.mean)]
    if found.interval is not None and metric.bounded:
        low, high = metric.scale * found.interval.low, metric.scale * found.interval.high
        decimals = 1 if metric.scale > 1.0 else 3
        parts.append(f"[{low:.{decimals}f}, {high:.{decimals}f}]")
    elif found.between_run_ci95 is not None:
        parts.append(f"±{_figure(metric.scale * (found.between_run_ci95.high - found.mean))}")
    if not metric.share and found.within_sd is not None:
        parts.append(f"({_figure(metric.scale * found.within_sd)})")
    return " ".join(parts)


def _change(metric: Metric, found: PairedDifference) -> str:
    if found.mean is None:
        return number(None)
    text = f"{metric.scale * found.mean:+.2f}"
    if found.between_run_ci95 is None:
        return text
    half = metric.scale * (found.between_run_ci95.high - found.mean)
    return f"{text} ±{_figure(half)}{' *' if found.distinct else '  '}"


def _figure(value: float) -> str:
    decimals = 2 if abs(value) < 10.0 else 1 if abs(value) < 100.0 else 0
    return f"{value:.{decimals}f}"


def _least(driver: PolicyReport, field: str) -> str:
    return f"{min(getattr(run, field) for run in driver.speed):.3f}"
