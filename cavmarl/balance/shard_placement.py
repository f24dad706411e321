"""`Placement`: shards on workers, and the resulting duration of each worker's tick.

A worker with LoadScore S, the share taken by other programs, has the speed 1 - S: shards that cost
`load` seconds take load / (1 - S) on it. Before shards are placed, the fastest worker is thus the
worker with the lowest LoadScore, as in eq. (2). The slowest worker determines the pace of all
workers. The imbalance is the duration of its tick / the duration with a perfect division.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.load_score import Candidate, Rejection, load_score
from cavmarl.balance.problem import Problem

Floats = NDArray[np.float64]
MIN_SPEED = 0.01  # minimum speed of a fully used worker, which keeps its tick finite


class Workers:
    """The workers that answer, by number.

    Attributes:
        scores: LoadScore of each worker.
        speeds: free share of each worker.
        is_open: whether each worker may receive shards.
    """

    def __init__(
        self,
        candidates: Sequence[Candidate],  # the workers
        rejections: Sequence[Rejection],  # reasons why workers are excluded
        weights: tuple[float, float, float],  # weights of the score
    ) -> None:
        self.numbers = tuple(candidate.worker for candidate in candidates)  # numbers of the workers
        self.scores = tuple(load_score(candidate.use, weights) for candidate in candidates)
        self.speeds: Floats = np.maximum(1.0 - np.array(self.scores), MIN_SPEED)
        rejected = {rejection.worker for rejection in rejections}
        self.is_open = np.array([number not in rejected for number in self.numbers])

    def __len__(self) -> int:
        return len(self.numbers)


class Placement:
    """An assignment of shards to workers."""

    def __init__(
        self,
        problem: Problem,  # the shards
        workers: Workers,  # workers that can host the shards
        homes: Iterable[int],  # index in `workers` of each shard's worker; -1: none yet
    ) -> None:
        self.problem = problem
        self.workers = workers
        self.homes = list(homes)

    def copy(self) -> Placement:
        return Placement(self.problem, self.workers, self.homes)

    def on(self, worker: int) -> list[int]:
        return [shard for shard, home in enumerate(self.homes) if home == worker]

    def load_s(self, worker: int) -> float:
        """Return the cost of the worker's shards; the exact sum does not depend on order."""
        return math.fsum(self.problem.shards[shard].cost_s for shard in self.on(worker))

    def loads_s(self) -> Floats:
        """Return `load_s` of all workers, (m,)."""
        return np.array([self.load_s(worker) for worker in range(len(self.workers))])

    def ticks_s(self) -> Floats:
        """Return the duration of each worker's tick, (m,)."""
        return np.asarray(self.loads_s() / self.workers.speeds)

    @property
    def makespan_s(self) -> float:
        return float(self.ticks_s().max())

    @property
    def fair_s(self) -> float:
        """Duration of a tick if shards could be divided freely among the admissible workers."""
        workers = self.workers
        able = workers.speeds[workers.is_open] if workers.is_open.any() else workers.speeds
        return math.fsum(shard.cost_s for shard in self.problem.shards) / math.fsum(able.tolist())

    @property
    def imbalance(self) -> float:
        """`makespan_s` divided by `fair_s`; 1 if nothing costs anything."""
        return self.makespan_s / self.fair_s if self.fair_s else 1.0

    @property
    def cut_pairs(self) -> int:
        return sum(self.homes[a] != self.homes[b] for a, b in self.problem.pairs)

    def excess_s(self) -> float:
        """Return the sum of the workers' excess over a perfect division's tick."""
        return math.fsum(np.maximum(self.ticks_s() - self.fair_s, 0.0).tolist())
