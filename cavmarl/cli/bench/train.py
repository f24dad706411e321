"""`cavmarl bench train`: how fast PPO is from end to end."""

from __future__ import annotations

from dataclasses import asdict
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

from cavmarl.bench.harness import BenchmarkReport, Say, is_kept, silent
from cavmarl.cli.output import AtLeast, about

if TYPE_CHECKING:
    from cavmarl.bench.training_speed import TrainingRow

_SIDES = {
    "cavmarl": "cavmarl",
    "cavmarl_recipe": "cavmarl, our recipe",
    "stable_baselines3": "SB3 on highway-env",
}
_PHASES = {
    "simu-\nlation": "simulation",
    "trans-\nfer": "transfer",
    "infer-\nence": "inference",
    "learn-\ning": "learning",
}


def train(
    agents: Annotated[int, about("Agents in each world, on both sides.")] = 20,
    worlds: Annotated[
        int, about("Number of our parallel worlds; highway-env has one a worker.")
    ] = 16,
    workers: Annotated[int, about("Worker processes of each side.")] = 2,
    repeats: Annotated[int, about("Number of measured updates of each side.")] = 3,
    at_least: AtLeast = None,
    say: Say = silent,
) -> BenchmarkReport:
    """PPO from end to end next to stable-baselines3's on highway-env, and where the time goes.

    Same road, vehicles, observation, network, batch and epochs. How fast our worlds are alone, with
    their sensors and without learning, is another benchmark and reported apart.
    """
    from cavmarl.bench.training_speed import measure_training

    found = measure_training(agents, worlds, workers, repeats, say)
    notes = [
        f"end to end, ours over theirs: [bold]{found.ratio:,.1f}[/]; our own recipe "
        f"({found.recipe_numbers} numbers): [bold]{found.recipe_rate:,.0f}[/] agent-steps/s",
        f"worlds and sensors alone, without learning: {median(found.stepping):,.0f} agent-steps/s",
    ]
    if found.is_crowded:
        notes.append("[yellow]note: more workers than cores[/]")
    return BenchmarkReport(
        f"PPO, {found.agents} agents a world, {found.numbers} numbers each, {found.workers} "
        "workers:\nagent-steps/s, and the share of the time in each phase",
        {
            "end to end": "side",
            "worlds": "worlds",
            "decisions\nan update": "decisions:,",
            "min": "low:,.0f",
            "median": "median:,.0f",
            "max": "high:,.0f",
            **{head: f"{phase}:.0%" for head, phase in _PHASES.items()},
        },
        [_row(side) for side in found.end_to_end],
        notes=notes,
        facts=found.facts(),
        holds=is_kept(at_least, found.ratio),
    )


def _row(side: TrainingRow) -> dict[str, Any]:
    rates = side.rates
    shown = {"low": min(rates), "median": median(rates), "high": max(rates), **side.shares}
    return {**asdict(side), "side": _SIDES[side.name], **shown}
