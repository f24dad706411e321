"""`cavmarl bench clock`: the drift between a master's clock and a follower's, Table II."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.bench.harness import make_table, measuring
from cavmarl.cli.output import (
    JsonPath,
    OptionalEnvironment,
    about,
    about_file,
    with_world,
    write_json,
)
from cavmarl.config.world_spec import WorldSpec

if TYPE_CHECKING:
    from cavmarl.bench.clock_drift import ClockDrift


@with_world("seed", "settings")
def clock(
    world: WorldSpec,
    env: OptionalEnvironment = "ring",
    steps: Annotated[int, about("Steps of the master; a step is one tick here.")] = 5000,
    rogue: Annotated[
        float, about("Share of steps in which the follower also ticks by itself.")
    ] = 0.0,
    own_ticks: Annotated[
        Literal["obey", "refuse", "ignore"],
        about("What the master does with such a tick; obey: the world really ticks."),
    ] = "obey",
    pace: Annotated[
        float | None,
        about("Simulated seconds a second; then a clock of the follower's own is read, too."),
    ] = None,
    csv_path: Annotated[Path | None, about_file("Write the table here.", "--csv")] = None,
    json_path: JsonPath = None,
) -> None:
    """Read a master's clock and that of a follower in another process, after the same steps."""
    from cavmarl.bench.clock_drift import measure_drift, write_rows

    console = Console()
    with measuring(console) as say:
        say(f"{steps} steps")
        found = measure_drift(world, steps=steps, rogue=rogue, answer=own_ticks, pace=pace)
    console.print(_table(found))
    console.print(_verdict(found), highlight=False)
    if csv_path is not None:
        write_rows(csv_path, found.rows)
    write_json(json_path, found.to_dict())
    if not found.holds:
        raise typer.Exit(1)


def _table(found: ClockDrift) -> Table:
    rows = []
    for row in found.rows:
        seconds = (row.master_s, row.follower_s, row.normalised_s, row.delta_s)
        own = "-" if row.own_delta_s is None else f"{row.own_delta_s:+.4f}"
        told = [f"{time_s:.1f}" for time_s in seconds]
        rows.append((str(row.step), *told, f"{row.ratio:.2f}", own))
    heads = (
        "step",
        "master, s",
        "follower, s",
        "normalised, s",
        "Δ, s",
        "ratio",
        "own clock, Δ, s",
    )
    return make_table(f"{found.environment}, {1000.0 * found.dt_s:g} ms a step", heads, rows)


def _verdict(found: ClockDrift) -> str:
    if not found.own_ticks:
        equal = "equal" if found.holds else "[bold]not equal[/]"
        return f"the follower did not tick by itself; the clocks are {equal}"
    told = f"the follower ticked by itself {found.own_ticks} times ({found.answer})"
    if found.noticed_ticks is None:
        return f"{told}; the master counted {found.counted}, and the world went on only with it"
    return (
        f"{told}; the master noticed {found.drift_events} times that the world had gone on without "
        f"it, first {found.noticed_ticks} of its ticks after the first time"
    )
