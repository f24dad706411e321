"""In a contiguous split, each worker has consecutive worlds, and only boundaries move."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.balance.balance_plan import Plan, make_plan
from cavmarl.balance.balancer import Balancer
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.balance.plan_file import plan_from_dict
from cavmarl.balance.plan_text import describe_plan
from cavmarl.balance.problem import BalanceRule, Problem, ShardCost, equal_costs
from cavmarl.core.errors import ConfigError, NoAdmissibleWorkerError
from tests.balance.shards import COSTS, busy

EAGER = BalanceRule(tolerance=0.0, move_s=0.0, max_moves=3)


def worlds(costs: list[float], snapshot: LoadSnapshot, rule: BalanceRule = EAGER) -> Problem:
    shards = tuple(ShardCost(world, 0, cost) for world, cost in enumerate(costs))
    return Problem(shards, ((),), snapshot, rule, in_row=True)


def best_row_s(problem: Problem) -> float:
    """Return the least makespan of all ways to cut the row."""
    costs = [shard.cost_s for shard in problem.shards]
    speeds = [1.0 - 0.6 * one.use.cpu for one in problem.snapshot.workers]
    cuts = combinations(range(1, len(costs)), len(speeds) - 1)
    return min(
        max(
            sum(costs[first:last]) / speed
            for (first, last), speed in zip(pairwise((0, *cut, len(costs))), speeds, strict=True)
        )
        for cut in cuts
    )


def check_row(plan: Plan, workers: int) -> None:
    assert list(plan.homes) == sorted(plan.homes)
    assert set(plan.homes) == set(range(workers))


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    workers = draw(st.integers(1, 4))
    costs = draw(st.lists(COSTS, min_size=workers, max_size=9))
    shares = draw(st.lists(st.floats(0.0, 0.8), min_size=workers, max_size=workers))
    return worlds(costs, busy(*shares))


@given(problems())
def test_the_first_plan_is_contiguous_and_nearly_optimal(problem: Problem) -> None:
    plan = make_plan(problem)
    check_row(plan, len(problem.snapshot.workers))
    slowest = min(plan.placement.workers.speeds)
    costliest = max(shard.cost_s for shard in problem.shards)
    assert plan.placement.makespan_s <= plan.placement.fair_s + costliest / slowest + 1e-9


@given(problems())
def test_rounds_with_few_moves_approach_the_best_contiguous_split(problem: Problem) -> None:
    plan = make_plan(replace(problem, shards=equal_costs(len(problem.shards), 1)))
    problem = replace(problem, present=plan.homes)
    plan = Plan(problem, plan.homes, "")
    for _ in range(40):
        before, plan = plan, make_plan(replace(problem, present=plan.homes))
        check_row(plan, len(problem.snapshot.workers))
        assert len(plan.moves) <= EAGER.max_moves
        assert plan.placement.excess_s() <= before.placement.excess_s() + 1e-9
        if not plan.moves:
            break
    assert not plan.moves
    slowest = min(plan.placement.workers.speeds)
    costliest = max(shard.cost_s for shard in problem.shards)
    assert plan.placement.makespan_s <= best_row_s(problem) + costliest / slowest + 1e-9


def test_surplus_shards_move_from_worker_to_adjacent_worker() -> None:
    snapshot = idle_snapshot(3)
    problem = replace(worlds([3.0, 3.0, 2.0, 2.0, 1.0], snapshot), present=(0, 0, 1, 1, 2))
    plan = make_plan(problem)
    assert plan.homes == (0, 1, 1, 2, 2)
    assert [(move.source, move.target) for move in plan.moves] == [(0, 1), (1, 2)]


def test_worlds_with_equal_costs_are_distributed_evenly() -> None:
    plan = make_plan(Problem(equal_costs(16, 1), ((),), idle_snapshot(3), in_row=True))
    assert sorted(plan.homes.count(worker) for worker in range(3)) == [5, 5, 6]
    nothing = worlds([0.0] * 6, idle_snapshot(2))
    assert make_plan(nothing).homes == (0, 0, 0, 1, 1, 1)


def test_an_excluded_worker_gets_no_more_shards() -> None:
    present = (0, 0, 0, 0, 1, 2)
    problem = replace(worlds([1.0] * 6, busy(0.0, 0.9, 0.0)), present=present)
    assert make_plan(problem).homes == present  # shards reach worker 2 only through worker 1
    with pytest.raises(NoAdmissibleWorkerError, match=r"worker 1: cpu .* fewer workers"):
        make_plan(replace(problem, present=None))


def test_the_loss_of_a_worker_leads_to_a_new_split() -> None:
    balancer = Balancer(worlds([1.0] * 6, idle_snapshot(3)))
    left = LoadSnapshot(idle_snapshot(3).workers[1:], "none", "")
    assert balancer.round(left).homes == (1, 1, 1, 2, 2, 2)


def test_a_present_assignment_that_is_not_contiguous_is_refused() -> None:
    with pytest.raises(ConfigError, match="must be ascending"):
        replace(worlds([1.0] * 3, idle_snapshot(2)), present=(0, 1, 0))


def test_a_contiguous_plan_read_from_json_equals_the_written_plan() -> None:
    problem = replace(
        worlds([1.0, 1.0, 4.0], idle_snapshot(2)), present=(0, 1, 1), cost_source="number"
    )
    plan = make_plan(problem)
    assert plan_from_dict(plan.to_dict()) == plan
    text = describe_plan(plan)
    assert "3 worlds on 2 workers" in text
    assert "costs by number" in text
    assert "ms" not in text
    assert "  world 1: worker 1 → 0" in text
    with pytest.raises(ConfigError, match="in_row = 3: must be a valid boolean"):
        plan_from_dict(plan.to_dict() | {"in_row": 3})
