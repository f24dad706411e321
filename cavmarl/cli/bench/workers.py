"""`cavmarl bench workers`: how much faster worlds are over several workers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.bench.harness import (
    check_positive,
    hardware_line,
    make_table,
    measuring,
    spread,
)
from cavmarl.cli.output import (
    Agents,
    Background,
    JsonPath,
    Seed,
    Settings,
    parse_settings,
    write_json,
)

if TYPE_CHECKING:
    from cavmarl.bench.worker_speed import WorkerSpeed


def workers(
    env: Annotated[
        str, typer.Argument(metavar="[ENV]", help="Name, folder or map file of an environment.")
    ] = "rush",
    worlds: Annotated[int, typer.Option(help="Number of parallel worlds.")] = 16,
    count: Annotated[
        int, typer.Option("--workers", help="Number of workers to compare with one worker.")
    ] = 2,
    agents: Agents = None,
    background: Background = None,
    steps: Annotated[int, typer.Option(help="Steps in each turn.")] = 20,
    repeats: Annotated[int, typer.Option(help="Turns of each number of workers.")] = 7,
    seed: Seed = 0,
    settings: Settings = None,
    at_least: Annotated[
        float | None, typer.Option(help="Exit with 1 if several are not so many times faster.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """The same worlds without workers, with one and with several; what an empty command costs."""
    from cavmarl.bench.core_ceiling import measure_ceiling
    from cavmarl.bench.worker_speed import measure_workers

    check_positive("--at-least", at_least)
    wanted = {
        "agents": agents,
        "background": background,
        "overrides": parse_settings(settings),
    }
    console = Console()
    with measuring(console) as say:
        found = measure_workers(
            env,
            worlds=worlds,
            workers=count,
            steps=steps,
            repeats=repeats,
            seed=seed,
            wanted=wanted,
            say=say,
        )
        say("stepping worlds in programs of their own")
        ceiling = measure_ceiling(
            env,
            worlds=worlds,
            programs=count,
            steps=steps,
            repeats=repeats,
            seed=seed,
            wanted=wanted,
        )
    write_json(json_path, found.to_dict() | {"ceiling": ceiling.to_dict()})
    console.print(_table(found))
    console.print(_sentence(found, count), highlight=False)
    console.print(
        f"{count} programs that share nothing, side by side: [bold]{ceiling.ratio:.2f}[/] times "
        "one after the other: more this machine does not give",
        highlight=False,
    )
    if found.is_crowded:
        console.print("note: more workers than cores", style="yellow")
    if at_least is not None and found.ratio < at_least:
        raise typer.Exit(1)


def _table(found: WorkerSpeed) -> Table:
    rows = []
    for row in found.rows:
        step_ms = spread(row.step_ms)
        busiest = "-" if row.busiest_ms is None else f"{row.busiest_ms:.2f}"
        times = (f"{ms:.2f}" for ms in (row.made_s, step_ms.low, step_ms.median, step_ms.high))
        rows.append((str(row.workers), *times, busiest))
    return make_table(
        f"{found.env}: {found.worlds} worlds, turns of {found.steps} steps\n"
        f"{hardware_line(found.hardware)}",
        ("workers", "made in, s", "step, ms: min", "median", "max", "busiest, ms"),
        rows,
    )


def _sentence(found: WorkerSpeed, count: int) -> str:
    low, middle, high, highest = found.barrier_us
    return (
        f"{count} workers over one: [bold]{found.ratio:.2f}[/], by the busiest one's processor "
        f"time {found.processor_ratio:.2f}; one worker costs {found.cost_of_one:.2f} times the "
        "step without\n"
        f"an empty command to all {count}: [bold]{middle:.1f}[/] µs "
        f"({low:.1f} / {high:.1f} / {highest:.1f}: 5, 95, 99 %); idle workers take "
        f"{found.idle_s:.1%} of a core"
    )
