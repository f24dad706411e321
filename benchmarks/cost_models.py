"""Models that the balance benchmark tries beside measured costs; no setting of cavmarl uses them.

Calibrated: the LoadScore stands for the share of a worker that its shards do not get. A worker that
took `tick_s` for shards that cost `load_s` has lost the share 1 - load_s / tick_s, and the weights
are those that explain the lost shares best. Predicted: a shard's coming cost is linear in the
vehicles, sensor readings and migrations in it now. No coefficient of either is below 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.load_score import WEIGHTS, Utilisation

Floats = NDArray[np.float64]


class LoggedTick(NamedTuple):
    """What others used of a worker, what its shards cost, and how long it took, seconds a tick."""

    use: Utilisation
    load_s: float
    tick_s: float


class ShardContent(NamedTuple):
    """What is in a shard in a tick: vehicles, readings of agents' sensors, vehicles that came."""

    vehicles: float
    readings: float
    migrations: float


class CostModel(NamedTuple):
    """Seconds a tick of a shard, and of each thing in it."""

    shard_s: float
    vehicle_s: float
    reading_s: float
    migration_s: float

    def predict(self, content: ShardContent) -> float:
        """What a shard with this content costs, seconds a tick."""
        return self.shard_s + float(np.dot(self[1:], content))

    def shift(self, cost_s: float, before: ShardContent, now: ShardContent) -> float:
        """What a shard costs with its content of now that cost `cost_s` with that before."""
        return max(cost_s + self.predict(now) - self.predict(before), 0.0)


def calibrate(
    log: Sequence[LoggedTick], given: tuple[float, float, float] = WEIGHTS
) -> tuple[float, float, float]:
    """Weights of CPU, RAM and GPU that sum to 1; those given where nothing can be learnt."""
    rows = [row for row in log if row.load_s > 0.0]
    if not rows:
        return given
    used = np.array([(row.use.cpu, row.use.ram, row.use.gpu) for row in rows])
    found = fit_non_negative(used, np.array([1.0 - row.load_s / row.tick_s for row in rows]))
    total = float(found.sum())
    if total == 0.0:
        return given
    cpu, ram, gpu = (found / total).tolist()
    return cpu, ram, gpu


def fit_costs(contents: Sequence[ShardContent], costs_s: Sequence[float]) -> CostModel:
    """The model that fits logged rows best."""
    rows = np.column_stack([np.ones(len(contents)), np.array(contents)])
    scale = np.abs(rows).max(axis=0)
    scale[scale == 0.0] = 1.0  # of what never was there
    return CostModel(*(fit_non_negative(rows / scale, np.array(costs_s)) / scale).tolist())


def fit_non_negative(rows: Floats, values: Floats) -> Floats:
    """Coefficients (c,) ≥ 0 that minimise |rows · coefficients - values|², of a few columns.

    The optimum is an ordinary least-squares fit on the columns that are not at 0 (Lawson and
    Hanson, Solving Least Squares Problems, 1974, chapter 23): all choices of them are tried.
    """
    columns = range(rows.shape[1])
    best, least = np.zeros(len(columns)), float(values @ values)
    for size in range(1, len(columns) + 1):
        for chosen in combinations(columns, size):
            some = np.linalg.lstsq(rows[:, chosen], values, rcond=None)[0]
            error = float(((rows[:, chosen] @ some - values) ** 2).sum())
            if (some >= 0.0).all() and error < least:
                least = error
                best = np.zeros(len(columns))
                best[list(chosen)] = some
    return best
