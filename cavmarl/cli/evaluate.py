"""`cavmarl evaluate`: seeded episodes of a driver, and what they say about it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from cavmarl.cli.output import (
    Agents,
    Background,
    Environment,
    JsonPath,
    PolicyName,
    Seed,
    Settings,
    number,
    parse_settings,
    write_json,
)

if TYPE_CHECKING:
    from cavmarl.evaluate import EvaluationReport
    from cavmarl.evaluate.statistics import Interval

__all__ = ["evaluate", "evaluate_showing", "progress_bar", "report_table"]


def evaluate(
    env: Environment,
    policy: PolicyName = "idm",
    episodes: Annotated[int, typer.Option("--episodes", "-n", help="How many.")] = 32,
    seed: Seed = 0,
    agents: Agents = None,
    background: Background = None,
    settings: Settings = None,
    json_path: JsonPath = None,
) -> None:
    """Drive seeded episodes and show success, collisions, comfort, delay and speed."""
    console = Console()
    report = evaluate_showing(
        console,
        env,
        policy,
        episodes=episodes,
        seed=seed,
        agents=agents,
        background=background,
        overrides=parse_settings(settings),
    )
    console.print(report_table({policy: report}))
    write_json(json_path, report.to_dict())


def evaluate_showing(console: Console, env: str, policy: str, **settings: Any) -> EvaluationReport:
    """`cavmarl.evaluate.evaluate` with a progress bar."""
    from cavmarl.evaluate import evaluate as run

    with progress_bar(console) as bar:
        task = bar.add_task(f"{policy} drives {env}")

        def progress(steps: int, most: int) -> None:
            bar.update(task, completed=steps, total=most)

        return run(env, policy, progress=progress, **settings)


def progress_bar(console: Console) -> Progress:
    """A bar that goes away when the work is done."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        console=console,
        transient=True,
    )


def report_table(reports: dict[str, EvaluationReport]) -> Table:
    """Reports side by side, one column a driver."""
    first = next(iter(reports.values()))
    title = f"{first.manifest.environment}, {first.episodes} episodes of seed {first.manifest.seed}"
    # Narrow enough for three drivers on eighty columns.
    table = Table(
        "",
        title=escape(title),
        caption="rates with their 95 % interval, means ± half of theirs",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for name in reports:
        table.add_column(escape(name), justify="right")
    columns = [_cells(report) for report in reports.values()]
    for row in columns[0]:
        table.add_row(row, *(column[row] for column in columns))
    return table


def _cells(report: EvaluationReport) -> dict[str, str]:
    speed = report.speed
    return {
        "trips": str(report.trips),
        "success, %": _rate(report.success),
        "collision, %": _rate(report.collision),
        "off road, %": _rate(report.off_road),
        "unfinished, %": _rate(report.unfinished),
        "red light, %": _rate(report.red_light),
        "wrong way, %": _rate(report.wrong_way),
        "episode return": _interval(report.episode_return),
        "least TTC, s": _interval(report.mean_least_ttc_s),
        "jerk, m/s³": _interval(report.mean_jerk_mps3),
        "speeding, %": _interval(report.mean_speeding, scale=100.0),
        "delay, s": _interval(report.mean_delay_s),
        "speed, m/s": number(report.mean_speed_mps),
        "world step, ms": f"{speed.step_ms:.3f}",
        "policy, ms": f"{speed.policy_ms:.3f}",
        "agent-steps/s": f"{speed.agent_steps_per_s:,.0f}",
    }


def _rate(interval: Interval) -> str:
    """A share in % and the ends of its interval, which reaches farther to one side."""
    if interval.mean is None:
        return number(None)
    share = f"{100.0 * interval.mean:.1f}"
    if interval.low is None or interval.high is None:
        return share
    return f"{share} [{100.0 * interval.low:.1f}, {100.0 * interval.high:.1f}]"


def _interval(interval: Interval, scale: float = 1.0) -> str:
    """The mean and half the width of its interval."""
    if interval.mean is None or interval.low is None or interval.high is None:
        return number(interval.mean, scale)
    half = number((interval.high - interval.low) / 2.0, scale)
    return f"{number(interval.mean, scale)} ± {half}"
