"""Cost models that the balance benchmark compares with measured costs; cavmarl does not use them.

Calibrated model: the LoadScore is the share of a worker that its shards do not get. If a worker
takes `tick_s` for shards that cost `load_s`, the lost share is 1 - load_s / tick_s. The weights of
the score are fitted to lost shares. Predicting model: the future cost of a shard is linear in its
present vehicles, sensor readings and migrations. No coefficient is negative.
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
    """The other load on a worker, and the cost and time of its shards in seconds per tick."""

    use: Utilisation  # by other programs
    load_s: float  # cost of the shards
    tick_s: float  # time of the shards


class ShardContent(NamedTuple):
    """The contents of a shard in a tick: vehicles, sensor readings of agents, arrived vehicles."""

    vehicles: float
    readings: float
    migrations: float


class CostModel(NamedTuple):
    """Cost of a shard and of each object in it, in seconds per tick."""

    shard_s: float
    vehicle_s: float
    reading_s: float
    migration_s: float

    def predict(self, content: ShardContent) -> float:
        """Return the cost of a shard with this content, in seconds per tick."""
        return self.shard_s + float(np.dot(self[1:], content))

    def shift(self, cost_s: float, before: ShardContent, now: ShardContent) -> float:
        """Return the cost of a shard after a change of its content."""
        return max(cost_s + self.predict(now) - self.predict(before), 0.0)


def calibrate(
    log: Sequence[LoggedTick], given: tuple[float, float, float] = WEIGHTS
) -> tuple[float, float, float]:
    """Return weights of CPU, RAM and GPU that sum to 1; `given` if they cannot be fitted."""
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
    """Return the cost model with the best fit to logged rows."""
    rows = np.column_stack([np.ones(len(contents)), np.array(contents)])
    scale = np.abs(rows).max(axis=0)
    scale[scale == 0.0] = 1.0  # columns without data
    return CostModel(*(fit_non_negative(rows / scale, np.array(costs_s)) / scale).tolist())


def fit_non_negative(rows: Floats, values: Floats) -> Floats:
    """Return coefficients (c,) ≥ 0 that minimise |rows · coefficients - values|².

    The optimum is an ordinary least-squares fit on the columns with positive coefficients (Lawson
    and Hanson, Solving Least Squares Problems, 1974, chapter 23). All subsets of columns are tried,
    so use it with few columns.
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
