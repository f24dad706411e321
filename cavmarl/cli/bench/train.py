"""`cavmarl bench train`: compares the end-to-end speed of PPO training."""

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
    "cavmarl_recipe": "cavmarl, recommended settings",
    "stable_baselines3": "SB3 on highway-env",
}
_PHASES = {
    "simu-\nlation": "simulation",
    "trans-\nfer": "transfer",
    "infer-\nence": "inference",
    "learn-\ning": "learning",
}


def train(
    agents: Annotated[
        int, about("Number of agents in each world, on both sides.", metavar="N")
    ] = 20,
    worlds: Annotated[
        int,
        about("Number of parallel worlds; highway-env has one per worker.", metavar="N"),
    ] = 16,
    workers: Annotated[int, about("Number of worker processes of each side.", metavar="N")] = 2,
    repeats: Annotated[int, about("Number of measured updates of each side.", metavar="N")] = 3,
    at_least: AtLeast = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare PPO training from end to end with Stable-Baselines3 on highway-env.

    Both sides have the same road, vehicles, observation, network, batch and epochs. The report
    shows the share of time of each phase, and the speed of the worlds without learning.
    """
    from cavmarl.bench.training_speed import measure_training

    found = measure_training(agents, worlds, workers, repeats, say)
    notes = [
        f"end to end, cavmarl over SB3: [bold]{found.ratio:,.1f}[/]; cavmarl's own recipe "
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
