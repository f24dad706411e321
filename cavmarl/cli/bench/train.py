"""`cavmarl bench train`: how fast PPO is from end to end."""

from __future__ import annotations

import math
from statistics import median
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import JsonPath, write_json
from cavmarl.core.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.bench.training_speed import TrainingSpeed

__all__ = ["train"]

_WHO = {
    "cavmarl": "cavmarl",
    "cavmarl_overlap": "cavmarl, --overlap",
    "stable_baselines3": "SB3 on highway-env",
}
_PHASES = ("simulation", "transfer", "inference", "learning")


def train(
    agents: Annotated[int, typer.Option(help="Of a world, on both sides.")] = 20,
    worlds: Annotated[int, typer.Option(help="Of ours; theirs are one a worker.")] = 16,
    workers: Annotated[int, typer.Option(help="Processes of each side.")] = 2,
    repeats: Annotated[int, typer.Option(help="Updates of each, by turns.")] = 3,
    at_least: Annotated[
        float | None, typer.Option(help="Exit with 1 if ours is not so many times as fast.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """PPO from end to end next to stable-baselines3's on highway-env, and where the time goes.

    Same road, vehicles, observation, network, batch and epochs. How fast our worlds are alone, with
    their sensors and without anybody who learns, is another benchmark and reported apart.
    """
    from cavmarl.bench.training_speed import measure_training

    if at_least is not None and not 0.0 < at_least < math.inf:
        raise ConfigError(f"--at-least {at_least:g}: must be a number above 0")
    console = Console()
    with console.status("") as status:
        found = measure_training(agents, worlds, workers, repeats, status.update)
    write_json(json_path, found.to_dict())
    console.print(_table(found))
    console.print(
        f"end to end, ours over theirs: [bold]{found.ratio:,.1f}[/]; collecting while learning "
        f"over one after the other: [bold]{found.overlap_ratio:.2f}[/]\n"
        f"worlds and sensors alone, nobody learns: {median(found.stepping):,.0f} agent-steps/s",
        highlight=False,
    )
    if found.is_crowded:
        console.print("note: more workers than cores", style="yellow")
    if at_least is not None and found.ratio < at_least:
        raise typer.Exit(1)


def _table(found: TrainingSpeed) -> Table:
    hardware = found.hardware
    table = Table(
        "end to end",
        title=escape(
            f"PPO, {found.agents} agents a world, {found.numbers} numbers each, "
            f"{found.workers} workers\n{hardware['cpu']}, {hardware['usable_cores']} cores"
        ),
    )
    for row in found.end_to_end:
        table.add_column(_WHO[row.who], justify="right")
    rows = found.end_to_end
    table.add_row("worlds", *(str(row.worlds) for row in rows))
    table.add_row("decisions an update", *(f"{row.decisions:,}" for row in rows))
    for name, of in (("min", min), ("median", median), ("max", max)):
        table.add_row(f"agent-steps/s: {name}", *(f"{of(row.rates):,.0f}" for row in rows))
    for phase in _PHASES:
        shares = (row.shares.get(phase) for row in rows)
        shown = ("-" if share is None else f"{share:.0%}" for share in shares)
        table.add_row(f"{phase}, of the time", *shown)
    return table
