"""Strategies that place shards in each round of a load trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.cost_models import LoggedTick, ShardContent, calibrate, fit_costs
from benchmarks.load_traces import LoadTrace
from cavmarl.balance.balancer import Balancer
from cavmarl.balance.cost_filter import NEWEST
from cavmarl.balance.problem import BalanceRule, Problem, ShardCost, equal_costs
from cavmarl.handoff.repartition_plan import propose_zones, vehicle_costs
from cavmarl.zones.partition.zone_partition import ZonePartition

__all__ = ["STRATEGIES", "LoadStrategy", "Placed", "StaticPlacement"]

STRATEGIES = ("static", "balanced", "calibrated", "predicted", "repartitioned")
RECUT_EVERY = 10  # least number of rounds between two cuts


@dataclass(frozen=True)
class Placed:
    """The placement of shards in one round."""

    partition: ZonePartition  # the zones
    homes: tuple[int, ...]  # worker of each zone
    moved_shards: int = 0  # shards moved since the previous round
    moved_vehicles: int = 0  # vehicles that changed their zone because the map was cut again


class StaticPlacement:
    """The baseline of paper A: shards are placed once, before any measurement, and never move.

    See `docs/explanation/papers.md`.

    Args:
        trace: the loads.
        rule: rule of the first plan.

    Attributes:
        partition: the present zones.
        balancer: the object that has the plan.
    """

    def __init__(self, trace: LoadTrace, rule: BalanceRule) -> None:
        self.trace = trace
        self.rule = rule
        self.partition = trace.partition
        self.balancer = self._begin(trace.partition, equal_costs(1, trace.partition.count), 0)

    def place(self, number: int) -> Placed:
        """Return the placement in a round, based on earlier rounds."""
        return Placed(self.partition, self.balancer.plan.homes)

    def learn(self, number: int) -> None:
        """Process the measurements of a round."""

    def _begin(
        self, partition: ZonePartition, costs: tuple[ShardCost, ...], number: int
    ) -> Balancer:
        snapshot = self.trace.rounds[number].snapshot
        return Balancer(Problem(costs, partition.side_neighbors, snapshot, self.rule))


class LoadStrategy(StaticPlacement):
    """Moves a few shards per round by measured costs; each extension can be switched on.

    Args:
        trace: the loads.
        rule: conditions for moving shards.
        warm: rounds before learnt values are used.
        calibrated: whether to fit the score's weights to the workers' times.
        predicted: whether to predict costs from the present contents of zones.
        repartitioned: whether to cut the map again if moving shards does not help, at most every
            `RECUT_EVERY` rounds.
    """

    def __init__(
        self,
        trace: LoadTrace,
        rule: BalanceRule,
        warm: int,
        *,
        calibrated: bool = False,
        predicted: bool = False,
        repartitioned: bool = False,
    ) -> None:
        super().__init__(trace, rule)
        self._warm = warm
        self._calibrated, self._predicted, self._recut = calibrated, predicted, repartitioned
        self._ticks: list[LoggedTick] = []
        self._contents: list[ShardContent] = []
        self._measured_s: list[float] = []
        self._usual = np.array(trace.contents(0, trace.partition))  # contents, smoothed like costs

    def place(self, number: int) -> Placed:
        """Return the placement in a round, based on earlier rounds."""
        before = self.balancer.plan.homes
        if number == 0:
            return Placed(self.partition, before)
        plan = self.balancer.round(
            self.trace.rounds[number].snapshot,
            costs=self._expected(number),
            rule=self._rule(number),
        )
        moved_vehicles = 0
        if self._may_cut(number) and plan.imbalance > 1.0 + self.rule.tolerance:
            moved_vehicles = self._cut_anew(number)
        homes = self.balancer.plan.homes
        moved = sum(one != other for one, other in zip(before, homes, strict=True))
        return Placed(self.partition, homes, moved, moved_vehicles)

    def learn(self, number: int) -> None:
        """Process the measurements of a round."""
        trace, partition = self.trace, self.partition
        measured_s = trace.measured_s(number, partition)
        contents = trace.contents(number, partition)
        self.balancer.measure(_shards(measured_s.tolist()))
        self._usual += NEWEST * (np.array(contents) - self._usual)
        self._contents += contents
        self._measured_s += measured_s.tolist()
        true_s = trace.costs_s(number, partition)
        homes = np.array(self.balancer.plan.homes)
        for candidate in trace.rounds[number].snapshot.workers:
            own = homes == candidate.worker
            tick_s = float(true_s[own].sum()) / (1.0 - candidate.use.cpu)
            load_s = min(float(measured_s[own].sum()), tick_s)
            self._ticks.append(LoggedTick(candidate.use, load_s, tick_s))

    def _rule(self, number: int) -> BalanceRule:
        if not self._calibrated or number < self._warm:
            return self.rule
        given = self.rule.load
        weights = calibrate(self._ticks, given.weights)
        return replace(self.rule, load=replace(given, weights=weights))

    def _expected(self, number: int) -> tuple[ShardCost, ...]:
        known = self.balancer.costs
        if not self._predicted or number < self._warm:
            return known
        model = fit_costs(self._contents, self._measured_s)
        now = self.trace.contents(number, self.partition)
        return tuple(
            shard._replace(cost_s=model.shift(shard.cost_s, ShardContent(*usual), content))
            for shard, usual, content in zip(known, self._usual.tolist(), now, strict=True)
        )

    def _may_cut(self, number: int) -> bool:
        return self._recut and number >= self._warm and number % RECUT_EVERY == 0

    def _cut_anew(self, number: int) -> int:
        """Cut the map again if this pays; return the number of vehicles that change their zone."""
        trace = self.trace
        places = trace.rounds[number - 1].places
        costs_s = [shard.cost_s for shard in self.balancer.costs]
        proposal = propose_zones(
            trace.network, self.partition, places, costs_s, tolerance=self.rule.tolerance
        )
        if proposal is None:
            return 0
        weights = vehicle_costs(self.partition.zones_of(places), costs_s)
        self.partition = proposal.partition
        zones = self.partition.zones_of(places)
        shared_s = np.bincount(zones, weights, self.partition.count).tolist()
        self.balancer = self._begin(self.partition, _shards(shared_s), number)
        return proposal.moved


def _shards(costs_s: Sequence[float]) -> tuple[ShardCost, ...]:
    """Return the shards of a trace's only world."""
    return tuple(ShardCost(0, zone, cost_s) for zone, cost_s in enumerate(costs_s))
