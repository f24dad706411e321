"""Choice of a worker: sensitivity to the LoadScore's weights, and time of a choice."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np

from benchmarks.program import run
from cavmarl.balance.load_score import (
    THRESHOLDS,
    WEIGHTS,
    Candidate,
    LoadRule,
    Utilisation,
    select,
)
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import Seed, about
from cavmarl.evaluate.statistics import share_interval

# Weights besides those of paper A (docs/explanation/papers.md): equal weights, other ratios,
# pairs, and single resources.
OTHER_WEIGHTS = (
    (1 / 3, 1 / 3, 1 / 3),
    (0.5, 0.25, 0.25),
    (0.7, 0.15, 0.15),
    (0.8, 0.2, 0.0),
    (0.8, 0.0, 0.2),
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
)
FEW, MANY = 5, 100  # workers per choice: to compare weights, and to time choices


def measure(
    choices: Annotated[int, about("Choices per set of weights.")] = 1000,
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Choose among random admissible workers with several weights, and time the choice."""
    check_range(choices=(choices, 1, 1_000_000))
    fleets = list(_fleets(FEW, choices, seed))
    paper = LoadRule()
    usual = [select(fleet, paper).worker for fleet in fleets]
    rows: list[dict[str, Any]] = []
    for weights in OTHER_WEIGHTS:
        say(f"weights {weights}")
        other = [select(fleet, LoadRule(weights)).worker for fleet in fleets]
        changed = sum(one != two for one, two in zip(usual, other, strict=True))
        regrets = [
            scores[two] - scores[one]
            for fleet, one, two in zip(fleets, usual, other, strict=True)
            for scores in (dict(select(fleet, paper).scores),)
        ]
        interval = share_interval(changed, choices)
        rows.append(
            {
                "weights": ", ".join(f"{weight:.2f}" for weight in weights),
                "changed": changed / choices,
                "changed95": None if interval is None else [interval.low, interval.high],
                "regret": float(np.mean(regrets)),
            }
        )
    spent = []
    for fleet in _fleets(MANY, choices, seed):
        began = time.perf_counter_ns()
        select(fleet, paper)
        spent.append(1e-3 * (time.perf_counter_ns() - began))
    latency = {f"p{quantile}": float(np.percentile(spent, quantile)) for quantile in (50, 95, 99)}
    timed = ", ".join(f"{name} {value:.0f} µs" for name, value in latency.items())
    return BenchmarkReport(
        f"weights compared with 0.6, 0.2, 0.2: {choices} choices of {FEW} workers",
        {
            "weights": "weights",
            "other choice": "changed:.2f",
            "its score minus the best, mean": "regret:.3f",
        },
        rows,
        notes=[f"one choice of {MANY} workers: {timed}"],
        facts={"choices": choices, "workers": FEW, "latency_us": latency},
    )


def _fleets(workers: int, count: int, seed: int) -> Iterator[list[Candidate]]:
    """Yield admissible workers with uniformly random utilisation."""
    draw = np.random.default_rng(seed)
    for _ in range(count):
        uses = (draw.random((workers, len(WEIGHTS))) * THRESHOLDS).tolist()
        yield [Candidate(worker, Utilisation(*use)) for worker, use in enumerate(uses)]


if __name__ == "__main__":
    run(measure)
