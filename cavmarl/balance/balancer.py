"""`Balancer`: the plan of a run, from the first one on, round by round."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from cavmarl.balance.balance_plan import Plan, make_plan
from cavmarl.balance.cost_filter import SmoothCosts
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.problem import MEASURED_COSTS, BalanceRule, Problem, ShardCost
from cavmarl.core.errors import ConfigError


class Balancer:
    """Keeps the plan, and what is known of the shards' costs.

    Attributes:
        plan: the present one; each is made again from its own problem.

    Raises:
        NoAdmissibleWorkerError: all workers are excluded.
    """

    def __init__(
        self,
        # shards, neighbours, workers and rule; `equal_costs` where nothing is measured yet
        first: Problem,
    ) -> None:
        self.plan: Plan = make_plan(first)
        self._smooth = SmoothCosts()
        self._costs = first.shards

    @property
    def costs(self) -> tuple[ShardCost, ...]:
        """What shards cost by all measurements up to now."""
        return self._costs

    def measure(self, measured: Iterable[ShardCost]) -> None:
        """Take in what all shards have cost lately, in any order."""
        rows = sorted(measured)
        names = [(shard.world, shard.zone) for shard in rows]
        if names != [(shard.world, shard.zone) for shard in self.plan.problem.shards]:
            raise ConfigError(f"measured shards {names}: must be those of the plan, each once")
        self._costs = self._smooth.update(rows)

    def round(
        self,
        snapshot: LoadSnapshot,  # of the workers that there are now
        *,
        costs: tuple[ShardCost, ...] | None = None,  # to go by; default: the measured ones
        rule: BalanceRule | None = None,  # default: that of the present plan
    ) -> Plan:
        """Move what has to be moved, and a few shards more if that is worth it.

        Raises:
            NoAdmissibleWorkerError: a worker is lost, and all others are excluded.
            ConfigError: more workers than shards, or a cost that is none.
        """
        before = self.plan
        self.plan = make_plan(
            replace(
                before.problem,
                shards=costs or self._costs,
                snapshot=snapshot,
                rule=rule or before.problem.rule,
                present=before.homes,
                cost_source=MEASURED_COSTS,
            )
        )
        return self.plan
