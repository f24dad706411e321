"""Smoothing of measured costs."""

from __future__ import annotations

from collections.abc import Iterable

from cavmarl.balance.problem import ShardCost
from cavmarl.core.errors import ConfigError

NEWEST = 0.3  # weight of the newest measurement


class SmoothCosts:
    """The exponentially weighted mean of each shard's cost."""

    def __init__(
        self,
        # weight of the newest measurement; the first measurement of a shard has the weight 1
        newest: float = NEWEST,
    ) -> None:
        if not 0.0 < newest <= 1.0:
            raise ConfigError(f"newest = {newest}: must be above 0 and at most 1")
        self._newest = newest
        self._mean_s: dict[tuple[int, int], float] = {}

    def update(self, measured: Iterable[ShardCost]) -> tuple[ShardCost, ...]:
        """Add one round of measurements and return the means of its shards."""
        means = []
        for shard in measured:
            name = (shard.world, shard.zone)
            before_s = self._mean_s.get(name, shard.cost_s)
            self._mean_s[name] = before_s + self._newest * (shard.cost_s - before_s)
            means.append(shard._replace(cost_s=self._mean_s[name]))
        return tuple(means)
