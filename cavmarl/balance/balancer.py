"""`Balancer`: keeps the plan of a run and updates it round by round."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from cavmarl.balance.balance_plan import Plan, make_plan
from cavmarl.balance.cost_filter import SmoothCosts
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.problem import MEASURED_COSTS, BalanceRule, Problem, ShardCost
from cavmarl.core.errors import ConfigError


class Balancer:
    """Keeps the plan and the measured costs of the shards.

    Attributes:
        plan: the current plan; reproducible from its own problem.

    Raises:
        NoAdmissibleWorkerError: all workers are excluded; with `Problem.in_row`, also if any worker
            is excluded.
    """

    def __init__(
        self,
        # shards, neighbours, workers and rule; `equal_costs` before anything is measured
        first: Problem,
    ) -> None:
        self.plan: Plan = make_plan(first)
        self._smooth = SmoothCosts()
        self._costs = first.shards

    @property
    def costs(self) -> tuple[ShardCost, ...]:
        """Costs of the shards, averaged over all measurements."""
        return self._costs

    def measure(self, measured: Iterable[ShardCost]) -> None:
        """Add the latest costs of all shards, in any order."""
        rows = sorted(measured)
        names = [(shard.world, shard.zone) for shard in rows]
        if names != [(shard.world, shard.zone) for shard in self.plan.problem.shards]:
            raise ConfigError(f"measured shards {names}: must be the shards of the plan, once each")
        self._costs = self._smooth.update(rows)

    def round(
        self,
        snapshot: LoadSnapshot,  # load of the current workers
        *,
        costs: tuple[ShardCost, ...] | None = None,  # default: the measured costs
        rule: BalanceRule | None = None,  # default: the rule of the current plan
    ) -> Plan:
        """Make the next plan: place lost shards, and move a few other shards if that saves time.

        Raises:
            NoAdmissibleWorkerError: a worker is lost, and all other workers are excluded; with
                `Problem.in_row`, also if any of them is excluded.
            ConfigError: there are more workers than shards, or a cost is invalid.
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
