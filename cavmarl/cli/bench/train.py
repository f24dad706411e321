"""`cavmarl bench train`: how fast PPO is from end to end."""

from __future__ import annotations

from statistics import median
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from rich.table import Table

from cavmarl.bench.harness import hardware_line, make_table, measuring
from cavmarl.cli.output import AtLeast, JsonPath, about, end_below, write_json

if TYPE_CHECKING:
    from cavmarl.bench.training_speed import TrainingSpeed

_SIDES = {
    "cavmarl": "cavmarl",
    "cavmarl_recipe": "cavmarl, our recipe",
    "stable_baselines3": "SB3 on highway-env",
}
_PHASES = ("simulation", "transfer", "inference", "learning")


def train(
    agents: Annotated[int, about("Agents in each world, on both sides.")] = 20,
    worlds: Annotated[
        int, about("Number of our parallel worlds; highway-env has one a worker.")
    ] = 16,
    workers: Annotated[int, about("Worker processes of each side.")] = 2,
    repeats: Annotated[int, about("Number of measured updates of each side.")] = 3,
    at_least: AtLeast = None,
    json_path: JsonPath = None,
) -> None:
    """PPO from end to end next to stable-baselines3's on highway-env, and where the time goes.

    Same road, vehicles, observation, network, batch and epochs. How fast our worlds are alone, with
    their sensors and without learning, is another benchmark and reported apart.
    """
    from cavmarl.bench.training_speed import measure_training

    console = Console()
    with measuring(console) as say:
        found = measure_training(agents, worlds, workers, repeats, say)
    write_json(json_path, found.to_dict())
    console.print(_table(found))
    console.print(
        f"end to end, ours over theirs: [bold]{found.ratio:,.1f}[/]; our own recipe "
        f"({found.recipe_numbers} numbers): [bold]{found.recipe_rate:,.0f}[/] agent-steps/s\n"
        f"worlds and sensors alone, without learning: {median(found.stepping):,.0f} agent-steps/s",
        highlight=False,
    )
    if found.is_crowded:
        console.print("note: more workers than cores", style="yellow")
    end_below(at_least, found.ratio)


def _table(found: TrainingSpeed) -> Table:
    sides = found.end_to_end
    rows = [
        ("worlds", *(str(side.worlds) for side in sides)),
        ("decisions an update", *(f"{side.decisions:,}" for side in sides)),
    ]
    for name, of in (("min", min), ("median", median), ("max", max)):
        rows.append((f"agent-steps/s: {name}", *(f"{of(side.rates):,.0f}" for side in sides)))
    for phase in _PHASES:
        cells = (f"{side.shares[phase]:.0%}" if phase in side.shares else "-" for side in sides)
        rows.append((f"{phase}, of the time", *cells))
    title = (
        f"PPO, {found.agents} agents a world, {found.numbers} numbers each, {found.workers} "
        f"workers\n{hardware_line(found.hardware)}"
    )
    return make_table(title, ("end to end", *(_SIDES[side.name] for side in sides)), rows)
