"""Extension, off by default: what a shard will cost, from what is in it now.

Measured costs are those of rounds gone by. How many vehicles a zone holds, how many sensors read
and how many vehicles change their zone is known at once. A linear model without negative
coefficients, fitted to logged rows, says what that will cost:

    cost_s = a + b · vehicles + c · readings + d · migrations

What a shard costs beside that, such as where its vehicles are, stays as it was measured: the model
says what a change of its content changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cavmarl.balance.least_squares import fit_non_negative
from cavmarl.core.errors import ConfigError

__all__ = ["CostModel", "ShardContent", "fit_costs"]


class ShardContent(NamedTuple):
    """What is in a shard in a tick.

    Attributes:
        vehicles: owned ones and ghosts.
        readings: of sensors of its agents.
        migrations: vehicles that came or went.
    """

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
        """What a shard will cost, seconds a tick."""
        return (
            self.shard_s
            + self.vehicle_s * content.vehicles
            + self.reading_s * content.readings
            + self.migration_s * content.migrations
        )

    def shift(self, cost_s: float, before: ShardContent, now: ShardContent) -> float:
        """What a shard will cost with its content of now that cost `cost_s` with that before."""
        return max(cost_s + self.predict(now) - self.predict(before), 0.0)


def fit_costs(contents: Sequence[ShardContent], costs_s: Sequence[float]) -> CostModel:
    """The model that fits logged rows best.

    Raises:
        ConfigError: no rows, not one cost each, or something that is no number.
    """
    if not contents or len(contents) != len(costs_s):
        raise ConfigError(f"{len(contents)} contents and {len(costs_s)} costs: one each")
    rows = np.column_stack([np.ones(len(contents)), np.array(contents)])
    scale = np.abs(rows).max(axis=0)
    scale[scale == 0.0] = 1.0  # of what never was there
    fitted = fit_non_negative(rows / scale, np.array(costs_s)) / scale
    return CostModel(*fitted.tolist())
