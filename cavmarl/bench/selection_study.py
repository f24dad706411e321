"""How much the choice of a worker depends on the weights, and how long choosing takes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cavmarl.balance.load_score import (
    THRESHOLDS,
    WEIGHTS,
    Candidate,
    LoadRule,
    Utilisation,
    select,
)
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.statistics import Interval, share_interval

__all__ = ["SelectionStudy", "WeightEffect", "study_selection"]

# Beside the paper's: all alike, each resource alone, and each pair.
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
FEW, MANY = 5, 100  # workers: to choose among, and to be timed with


@dataclass(frozen=True)
class WeightEffect:
    """Other weights beside the paper's.

    Attributes:
        weights: of CPU, RAM and GPU.
        changed: share of choices that are others.
        changed95: of that share.
        regret: mean of how much higher the paper's score of the other choice is.
    """

    weights: tuple[float, float, float]
    changed: float
    changed95: Interval | None
    regret: float


@dataclass(frozen=True)
class SelectionStudy:
    """Result of `study_selection`.

    Attributes:
        choices: how many were made with each weights.
        workers: to choose among.
        effects: by weights.
        timed_workers: to choose among while time was taken.
        latency_us: of one choice, by quantile: `p50`, `p95`, `p99`.
    """

    choices: int
    workers: int
    effects: tuple[WeightEffect, ...]
    timed_workers: int
    latency_us: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def study_selection(choices: int = 1000, seed: int = 0) -> SelectionStudy:
    """Choose among random admissible workers with several weights, and take the time.

    Args:
        choices: with each weights.
        seed: of the workers.

    Raises:
        ConfigError: no choices.
    """
    if choices < 1:
        raise ConfigError(f"choices = {choices}: must be at least 1")
    fleets = list(_fleets(FEW, choices, seed))
    paper = LoadRule()
    usual = [select(fleet, paper).worker for fleet in fleets]
    effects = []
    for weights in OTHER_WEIGHTS:
        other = [select(fleet, LoadRule(weights)).worker for fleet in fleets]
        changed = sum(one != two for one, two in zip(usual, other, strict=True))
        regrets = [
            scores[two] - scores[one]
            for fleet, one, two in zip(fleets, usual, other, strict=True)
            for scores in (dict(select(fleet, paper).scores),)
        ]
        effects.append(
            WeightEffect(
                weights,
                changed / choices,
                share_interval(changed, choices),
                float(np.mean(regrets)),
            )
        )
    spent = []
    for fleet in _fleets(MANY, choices, seed):
        began = time.perf_counter_ns()
        select(fleet, paper)
        spent.append(1e-3 * (time.perf_counter_ns() - began))
    latency = {f"p{quantile}": float(np.percentile(spent, quantile)) for quantile in (50, 95, 99)}
    return SelectionStudy(choices, FEW, tuple(effects), MANY, latency)


def _fleets(workers: int, count: int, seed: int) -> Iterator[list[Candidate]]:
    """Admissible workers, uniform in what is used of them."""
    draw = np.random.default_rng(seed)
    for _ in range(count):
        uses = (draw.random((workers, len(WEIGHTS))) * THRESHOLDS).tolist()
        yield [Candidate(worker, Utilisation(*use)) for worker, use in enumerate(uses)]
