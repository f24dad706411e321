"""`Placement`: shards on workers, and how long each worker takes for a tick.

A worker of which the share S (its LoadScore) is taken by others has the speed 1 - S: shards that
cost `load` seconds take it load / (1 - S). With nothing placed yet that is least where LoadScore
is: eq. (2). The slowest worker sets the pace of all; how many times as long it takes as a perfect
division would is the imbalance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.load_score import Candidate, Rejection, load_score
from cavmarl.balance.problem import Problem

Floats = NDArray[np.float64]
MIN_SPEED = 0.01  # of a worker that has nothing left: it is slow, not endless


class Workers:
    """The workers that answer, in the order of their numbers.

    Attributes:
        scores: their LoadScores.
        speeds: what is left of each.
        is_open: which ones may be given shards.
    """

    def __init__(
        self,
        candidates: Sequence[Candidate],  # them
        rejections: Sequence[Rejection],  # why some of them are given nothing more
        weights: tuple[float, float, float],  # of the score
    ) -> None:
        self.numbers = tuple(candidate.worker for candidate in candidates)  # of the workers
        self.scores = tuple(load_score(candidate.use, weights) for candidate in candidates)
        self.speeds: Floats = np.maximum(1.0 - np.array(self.scores), MIN_SPEED)
        rejected = {rejection.worker for rejection in rejections}
        self.is_open = np.array([number not in rejected for number in self.numbers])

    def __len__(self) -> int:
        return len(self.numbers)


class Placement:
    """Which shard is on which worker."""

    def __init__(
        self,
        problem: Problem,  # the shards
        workers: Workers,  # those that can host them
        homes: Iterable[int],  # place in `workers` of each shard's one; -1: it has none yet
    ) -> None:
        self.problem = problem
        self.workers = workers
        self.homes = list(homes)

    def copy(self) -> Placement:
        return Placement(self.problem, self.workers, self.homes)

    def on(self, worker: int) -> list[int]:
        return [shard for shard, home in enumerate(self.homes) if home == worker]

    def load_s(self, worker: int) -> float:
        """What its shards cost, added exactly: no order counts."""
        return math.fsum(self.problem.shards[shard].cost_s for shard in self.on(worker))

    def loads_s(self) -> Floats:
        """`load_s` of all workers, (m,)."""
        return np.array([self.load_s(worker) for worker in range(len(self.workers))])

    def ticks_s(self) -> Floats:
        """How long each worker takes for a tick, (m,)."""
        return np.asarray(self.loads_s() / self.workers.speeds)

    @property
    def makespan_s(self) -> float:
        return float(self.ticks_s().max())

    @property
    def fair_s(self) -> float:
        """How long all would take if shards could be divided at will among the admissible."""
        workers = self.workers
        able = workers.speeds[workers.is_open] if workers.is_open.any() else workers.speeds
        return math.fsum(shard.cost_s for shard in self.problem.shards) / math.fsum(able.tolist())

    @property
    def imbalance(self) -> float:
        """`makespan_s` over `fair_s`; 1 where nothing costs anything."""
        return self.makespan_s / self.fair_s if self.fair_s else 1.0

    @property
    def cut_pairs(self) -> int:
        return sum(self.homes[a] != self.homes[b] for a, b in self.problem.pairs)

    def excess_s(self) -> float:
        """By how much workers take longer than a perfect division would, summed over them."""
        return math.fsum(np.maximum(self.ticks_s() - self.fair_s, 0.0).tolist())
