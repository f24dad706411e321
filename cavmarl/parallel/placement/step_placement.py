"""`StepPlacement`: which worker hosts which shard, with rounds of balancing between steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.balancer import Balancer
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.balance.problem import BalanceRule, ShardCost
from cavmarl.engine.world_setup import World
from cavmarl.parallel.placement.work_shares import make_plans

if TYPE_CHECKING:
    from cavmarl.balance.probe import Watch

Floats = NDArray[np.float64]


class StepPlacement:
    """The plans of all workers: one plan of all worlds, or one plan of the zones of each world.

    Raises:
        ConfigError: there are more workers than zones of all worlds.
        NoAdmissibleWorkerError: workers are too busy.
    """

    def __init__(
        self,
        world: World,
        num_worlds: int,
        workers: int,
        is_here: bool = True,  # whether all workers are on this machine
    ) -> None:
        settings = world.config.workers
        self._rule = BalanceRule(
            tolerance=settings.imbalance_tolerance,
            max_moves=settings.max_moves,
            keeps_one=not is_here,
        )
        self._ticks_per_step = world.config.clock.ticks_per_step
        self._watches = settings.monitor_cpu and is_here
        seen = _present_snapshot(workers) if self._watches else None
        plans = make_plans(world, num_worlds, workers, seen, self._rule)
        self._balancers = [Balancer(plan.problem) for plan in plans]
        self._watch: Watch | None = None
        self._pids: Mapping[int, int] = {}
        self._before_s: Floats = np.zeros((num_worlds, 1 if self.in_row else world.partition.count))

    @property
    def in_row(self) -> bool:
        """True if workers have whole worlds with consecutive numbers."""
        return self._balancers[0].plan.problem.in_row

    @property
    def plans(self) -> tuple[Plan, ...]:
        return tuple(balancer.plan for balancer in self._balancers)

    def watch(self, pids: Mapping[int, int]) -> None:
        """Watch the machine from now on, if the configuration wants it."""
        if self._watches:
            from cavmarl.balance.probe import Watch  # psutil is only needed here

            self._watch, self._pids = Watch(pids), dict(pids)

    def round(
        self,
        spent_s: Floats,  # (W, zones) total processor time of each shard; (W, 1) for whole worlds
        steps: int,  # number of steps since the last round
        seen: LoadSnapshot,  # how busy workers are
    ) -> bool:  # whether shards have to move
        """Make new plans from the costs of shards since the last round."""
        cost_s = (spent_s - self._before_s) / (steps * self._ticks_per_step)
        self._before_s = spent_s.copy()
        for balancer in self._balancers:
            problem = balancer.plan.problem
            numbers = {candidate.worker for candidate in problem.snapshot.workers}
            if len(numbers) == 1:
                continue
            balancer.measure(
                ShardCost(shard.world, shard.zone, cost_s.item(shard.world, shard.zone))
                for shard in problem.shards
            )
            theirs = tuple(one for one in seen.workers if one.worker in numbers)
            balancer.round(replace(seen, workers=theirs), rule=self._rule)
        return any(plan.moves for plan in self.plans)

    def take_back(self, plans: Sequence[Plan]) -> None:
        """Return to earlier plans after a failed move."""
        for balancer, plan in zip(self._balancers, plans, strict=True):
            balancer.plan = plan

    def moved(self, lasted_s: float) -> int:  # number of moved shards
        """Note the duration of the moves, which later rounds compare with their gain."""
        moves = sum(len(plan.moves) for plan in self.plans)
        self._rule = replace(self._rule, move_s=lasted_s / moves)
        return moves

    def snapshot(
        self,
        pids: Mapping[int, int],  # worker → process
    ) -> LoadSnapshot:
        """Return how busy workers are; idle if unknown, as after the replacement of a worker."""
        watch, before = self._watch, self._pids
        self.watch(pids)
        if watch is None or before != pids:
            return idle_snapshot(len(pids))
        return watch.snapshot()


def _present_snapshot(workers: int) -> LoadSnapshot:
    from cavmarl.balance.probe import take_snapshot

    return take_snapshot(dict.fromkeys(range(workers)))
