"""The plan of a run follows measured costs with a limited number of moves per round."""

from __future__ import annotations

import pytest

from cavmarl.balance.balance_plan import replan
from cavmarl.balance.balancer import Balancer
from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.balance.problem import BalanceRule, Problem, ShardCost, equal_costs
from cavmarl.core.errors import ConfigError
from tests.balance.shards import grid, row


@pytest.fixture
def balancer() -> Balancer:
    return Balancer(Problem(equal_costs(4, 4), grid(2, 2), idle_snapshot(2)))


def test_unmeasured_worlds_are_distributed_without_splits(balancer: Balancer) -> None:
    homes = balancer.plan.homes
    assert [len({*homes[first : first + 4]}) for first in (0, 4, 8, 12)] == [1, 1, 1, 1]
    assert homes.count(0) == homes.count(1) == 8


def test_a_round_uses_the_measured_costs(balancer: Balancer) -> None:
    heavy = balancer.plan.homes[0]
    costs = [4.0 if home == heavy else 1.0 for home in balancer.plan.homes]
    balancer.measure(reversed(row(costs, worlds=4)))
    assert [shard.cost_s for shard in balancer.costs] == costs
    before = balancer.plan.homes
    plan = balancer.round(idle_snapshot(2))
    assert plan is balancer.plan
    assert 0 < len(plan.moves) <= BalanceRule().max_moves
    assert {move.source for move in plan.moves} >= {heavy}
    assert plan.problem.present == before
    assert replan(plan, plan.problem.snapshot) == plan


def test_a_new_measurement_changes_the_cost_only_partly(balancer: Balancer) -> None:
    balancer.measure(row([1.0] * 16, worlds=4))
    balancer.measure(row([2.0] * 16, worlds=4))
    assert {shard.cost_s for shard in balancer.costs} == {1.3}


def test_a_round_can_use_given_costs_and_another_rule(balancer: Balancer) -> None:
    strict = BalanceRule(tolerance=0.0, move_s=0.0, max_moves=1)
    costs = tuple(ShardCost(*shard[:2], 1.0 + shard.zone) for shard in balancer.costs)
    plan = balancer.round(idle_snapshot(2), costs=costs, rule=strict)
    assert plan.problem.shards == costs
    assert plan.problem.rule == strict


def test_shards_of_a_lost_worker_are_placed_in_the_next_round(balancer: Balancer) -> None:
    left = LoadSnapshot(idle_snapshot(2).workers[1:], "none", "")
    assert set(balancer.round(left).homes) == {1}


@pytest.mark.parametrize("costs", [[1.0] * 15, [1.0] * 20])
def test_shards_that_are_not_in_the_plan_are_refused(
    balancer: Balancer, costs: list[float]
) -> None:
    shards = tuple(ShardCost(n // 4, n % 4, cost) for n, cost in enumerate(costs))
    with pytest.raises(ConfigError, match="must be the shards of the plan"):
        balancer.measure(shards)


@pytest.mark.parametrize("keeps_one", [False, True])
def test_a_busy_worker_keeps_its_last_shard_if_keeps_one_is_set(keeps_one: bool) -> None:
    rule = BalanceRule(tolerance=0.0, move_s=0.0, keeps_one=keeps_one)
    first = Problem(equal_costs(1, 4), grid(2, 2), idle_snapshot(2), rule)
    balancer = Balancer(first)
    balancer.measure(row([0.1 if home else 5.0 for home in balancer.plan.homes]))
    idle, busy = idle_snapshot(2), Utilisation(0.99, 0.1)
    workers = (Candidate(0, busy), idle.workers[1])
    for _ in range(4):
        balancer.round(LoadSnapshot(workers, idle.gpu_source, idle.origin))
    assert balancer.plan.homes.count(0) == keeps_one
