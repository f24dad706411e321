"""`cavmarl verify workers`: checks that results survive the death of worker processes."""

from __future__ import annotations

from bisect import bisect_right
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import (
    RUN,
    JsonPath,
    PolicyName,
    about,
    grid,
    with_world,
    write_json,
)
from cavmarl.cli.verify import options
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.verify.worker_kills import Kill, KillReport

BOUNDS_MS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
WIDTH = 30  # characters of the longest bar


@with_world()
def verify_workers(
    world: WorldSpec,
    kill: Annotated[
        int, about("Number of workers to kill or to stop at random times.", metavar="N")
    ] = 10,
    backend: Annotated[
        str | None,
        about(
            "Where the worlds run: processes:N [default: processes:2].",
            metavar="BACKEND",
            panel=RUN,
        ),
    ] = None,
    workers: Annotated[
        int | None, about("Short form of --backend processes:N.", metavar="N", panel=RUN)
    ] = None,
    worlds: Annotated[
        int | None,
        about("Number of parallel worlds [default: two for each worker].", metavar="N"),
    ] = None,
    zones: options.ZoneCount = None,
    steps: Annotated[
        int | None, about("Number of steps to compare [default: three for each kill].", metavar="N")
    ] = None,
    policy: PolicyName = "idm",
    json_path: JsonPath = None,
) -> None:
    """Kill and stop worker processes, and compare their worlds with undisturbed ones.

    If a result or a state differs, print the step and exit with 1.
    """
    from cavmarl.verify.worker_kills import verify_kills

    world = with_sensors_of_drivers(world, [policy])
    console = Console()
    with counting(console, f"{kill} workers of {world.env} are killed or stopped") as progress:
        found = verify_kills(
            world, kill, backend=backend, workers=workers, worlds=worlds, zones=zones,
            steps=steps, policy=policy, progress=progress,
        )  # fmt: skip
    write_json(json_path, found.to_dict())
    _print(console, found)
    if not found.holds:
        raise typer.Exit(1)


def _print(console: Console, found: KillReport) -> None:
    hardware = found.hardware
    console.print(
        f"{escape(Path(found.env).name)}: {found.worlds} worlds over {found.workers} workers, "
        f"{found.steps} steps of {found.step_ms:.3g} ms; {len(found.kills)} deaths\n"
        f"an empty command to all workers: {found.ping_us:.3g} µs\n"
        f"{hardware['cpu']}, {hardware['usable_cores']} cores",
        highlight=False,
    )
    if found.workers > (hardware["usable_cores"] or found.workers):
        console.print("note: more workers than cores", style="yellow")
    console.print(_spreads(found))
    console.print(_histogram(found.kills))
    if found.holds:
        console.print(f"[green]equal[/] in all {found.steps} steps", highlight=False)
    else:
        console.print(f"[red]different[/] after step {found.different}", highlight=False)


def _spreads(found: KillReport) -> Table:
    import numpy as np

    rows = []
    for text, kind, name in (
        ("killed during a step: detected after, ms", "SIGKILL", "noticed_ms"),
        ("stopped during a step: detected after, ms", "SIGSTOP", "noticed_ms"),
        ("replacement received the command after, ms", None, "replaced_ms"),
        ("replacement finished the command after, ms", None, "recovered_ms"),
    ):
        values = [
            getattr(kill, name)
            for kill in found.kills
            if kind is None or (kill.signal == kind and not kill.idle)
        ]
        shown = [f"{np.percentile(values, p):.3g}" if values else "-" for p in (50, 95, 99, 100)]
        rows.append((text, str(len(values)), *shown))
    return grid(("", "deaths", "p50", "p95", "p99", "max"), rows, lefts=2)


def _histogram(kills: tuple[Kill, ...]) -> Table:
    names = ("noticed_ms", "recovered_ms")
    counts = {name: [0] * (len(BOUNDS_MS) + 1) for name in names}
    for kill in kills:
        for name in names:
            counts[name][bisect_right(BOUNDS_MS, getattr(kill, name))] += 1
    most = max(1, *(max(column) for column in counts.values()))
    rows = []
    labels = [f"below {BOUNDS_MS[0]}", *(f"from {bound}" for bound in BOUNDS_MS)]
    for n, label in enumerate(labels):
        if any(counts[name][n] for name in names):
            found = [counts[name][n] for name in names]
            rows.append((label, *(f"{'█' * -(-WIDTH * n // most)} {n}" for n in found)))
    return grid(("ms", "detected", "recovered"), rows, lefts=3)
