"""`cavmarl bench train`: how fast PPO is from end to end."""

from __future__ import annotations

from statistics import median
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.bench.harness import check_positive, hardware_line, make_table, measuring
from cavmarl.cli.output import JsonPath, write_json

if TYPE_CHECKING:
    from cavmarl.bench.training_speed import TrainingSpeed

_SIDES = {
    "cavmarl": "cavmarl",
    "cavmarl_overlap": "cavmarl, --overlap",
    "stable_baselines3": "SB3 on highway-env",
}
_PHASES = ("simulation", "transfer", "inference", "learning")


def train(
    agents: Annotated[int, typer.Option(help="Agents in each world, on both sides.")] = 20,
    worlds: Annotated[
        int, typer.Option(help="Number of our parallel worlds; highway-env has one a worker.")
    ] = 16,
    workers: Annotated[int, typer.Option(help="Worker processes of each side.")] = 2,
    repeats: Annotated[int, typer.Option(help="Number of measured updates of each side.")] = 3,
    at_least: Annotated[
        float | None, typer.Option(help="Exit with 1 if ours is not so many times as fast.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """PPO from end to end next to stable-baselines3's on highway-env, and where the time goes.

    Same road, vehicles, observation, network, batch and epochs. How fast our worlds are alone, with
    their sensors and without learning, is another benchmark and reported apart.
    """
    from cavmarl.bench.training_speed import measure_training

    check_positive("--at-least", at_least)
    console = Console()
    with measuring(console) as say:
        found = measure_training(agents, worlds, workers, repeats, say)
    write_json(json_path, found.to_dict())
    console.print(_table(found))
    console.print(
        f"end to end, ours over theirs: [bold]{found.ratio:,.1f}[/]; collecting while learning "
        f"over one after the other: [bold]{found.overlap_ratio:.2f}[/]\n"
        f"worlds and sensors alone, without learning: {median(found.stepping):,.0f} agent-steps/s",
        highlight=False,
    )
    if found.is_crowded:
        console.print("note: more workers than cores", style="yellow")
    if at_least is not None and found.ratio < at_least:
        raise typer.Exit(1)


def _table(found: TrainingSpeed) -> Table:
    sides = found.end_to_end
    rows = [
        ("worlds", *(str(side.worlds) for side in sides)),
        ("decisions an update", *(f"{side.decisions:,}" for side in sides)),
    ]
    for name, of in (("min", min), ("median", median), ("max", max)):
        rows.append((f"agent-steps/s: {name}", *(f"{of(side.rates):,.0f}" for side in sides)))
    for phase in _PHASES:
        shares = (side.shares.get(phase) for side in sides)
        cells = ("-" if share is None else f"{share:.0%}" for share in shares)
        rows.append((f"{phase}, of the time", *cells))
    return make_table(
        f"PPO, {found.agents} agents a world, {found.numbers} numbers each, {found.workers} "
        f"workers\n{hardware_line(found.hardware)}",
        ("end to end", *(_SIDES[side.who] for side in sides)),
        rows,
    )
