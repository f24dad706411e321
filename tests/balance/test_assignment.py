"""Compare plans with optimal plans, under adverse loads, and over several rounds."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl.balance.balance_plan import Plan, make_plan
from cavmarl.balance.cost_filter import SmoothCosts
from cavmarl.balance.load_score import Candidate, LoadRule, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.balance.problem import BalanceRule, Problem, ShardCost
from cavmarl.core.errors import ConfigError, NoAdmissibleWorkerError
from tests.balance.shards import COSTS, busy, grid, least_makespan_s, row

STRICT = BalanceRule(tolerance=0.0)


def alone(costs: list[float], snapshot: LoadSnapshot, rule: BalanceRule | None = None) -> Problem:
    """Return a problem of shards without neighbors."""
    return Problem(row(costs), ((),) * len(costs), snapshot, rule or BalanceRule())


@settings(deadline=None)
@given(st.lists(COSTS, min_size=3, max_size=7), st.integers(1, 3))
def test_the_makespan_of_equal_workers_is_within_grahams_bound(
    costs: list[float], workers: int
) -> None:
    problem = alone(costs, idle_snapshot(workers), STRICT)
    bound = 4.0 / 3.0 - 1.0 / (3.0 * workers)
    assert make_plan(problem).placement.makespan_s <= bound * least_makespan_s(problem) + 1e-12


@settings(deadline=None)
@given(
    st.lists(COSTS, min_size=3, max_size=7), st.lists(st.floats(0.0, 0.85), min_size=2, max_size=3)
)
def test_the_makespan_of_unequal_workers_is_at_most_twice_the_optimum(
    costs: list[float], cpus: list[float]
) -> None:
    problem = alone(costs, busy(*cpus), STRICT)
    assert make_plan(problem).placement.makespan_s <= 2.0 * least_makespan_s(problem) + 1e-12


def test_most_small_plans_are_optimal() -> None:
    draw = random.Random(0)
    best = 0
    for _ in range(100):
        costs = [draw.uniform(0.1, 1.0) for _ in range(7)]
        problem = alone(costs, busy(draw.uniform(0.0, 0.8), 0.0, 0.3), STRICT)
        found = make_plan(problem).placement.makespan_s
        best += found <= least_makespan_s(problem) * (1.0 + 1e-9)
    assert best > 60


def test_the_first_shard_goes_to_the_worker_with_the_lowest_score() -> None:
    plan = make_plan(alone([1.0, 0.0, 0.0], busy(0.5, 0.1, 0.3)))
    assert plan.homes[0] == 1


@settings(deadline=None)
@given(
    st.lists(COSTS, min_size=4, max_size=8),
    st.lists(st.floats(0.0, 0.85), min_size=1, max_size=4),
    st.randoms(use_true_random=False),
)
def test_the_order_of_the_input_does_not_matter(
    costs: list[float], cpus: list[float], draw: random.Random
) -> None:
    problem = Problem(row(costs), grid(1, len(costs)), busy(*cpus))
    shards, workers = list(problem.shards), list(problem.snapshot.workers)
    draw.shuffle(shards)
    draw.shuffle(workers)
    shuffled = Problem(tuple(shards), problem.neighbors, LoadSnapshot(tuple(workers), "none", ""))
    assert make_plan(shuffled).homes == make_plan(problem).homes


@pytest.mark.parametrize(
    ("costs", "loads"),
    [
        ([10.0, 0.1, 0.1, 0.1], [10.0, 0.3]),  # a very expensive shard has its own worker
        ([1.0] * 6, [3.0, 3.0]),
        ([0.0, 0.0, 0.0, 5.0], [0.0, 5.0]),
        ([5e-324, 5e-324, 1.0, 1.0], [1.0, 1.0]),
        ([1e6, 1e-6, 1e6, 1e-6], [1e6, 1e6]),
    ],
)
def test_extreme_costs_give_the_expected_loads(costs: list[float], loads: list[float]) -> None:
    plan = make_plan(alone(costs, idle_snapshot(2)))
    assert sorted(worker.load_s for worker in plan.workers()) == pytest.approx(sorted(loads))


def test_shards_without_cost_are_divided_by_number() -> None:
    plan = make_plan(alone([0.0] * 9, idle_snapshot(3)))
    assert [worker.shards for worker in plan.workers()] == [3, 3, 3]
    assert plan.imbalance == 1.0


def test_worlds_are_not_split_if_a_split_is_hardly_faster() -> None:
    plan = make_plan(Problem(row([1.0] * 64, worlds=16), grid(2, 2), idle_snapshot(2)))
    assert plan.placement.cut_pairs == 0
    assert plan.imbalance == 1.0


def test_a_world_that_costs_more_than_the_mean_load_of_a_worker_is_split() -> None:
    costs = [4.0] * 4 + [1.0] * 8
    plan = make_plan(Problem(row(costs, worlds=3), grid(2, 2), idle_snapshot(2)))
    assert plan.imbalance <= 1.1
    split = [
        world for world in range(3) if len({plan.homes[4 * world + zone] for zone in range(4)}) > 1
    ]
    assert split == [0]


def test_neighboring_zones_are_assigned_to_the_same_worker() -> None:
    zones = grid(4, 4)
    plan = make_plan(Problem(row([1.0] * 16), zones, idle_snapshot(4)))
    assert plan.imbalance == 1.0
    assert (
        plan.placement.cut_pairs <= 12
    )  # four rows cut 12 pairs; a round-robin assignment would cut 24


@settings(deadline=None)
@given(st.lists(COSTS, min_size=3, max_size=7), st.integers(2, 3))
def test_keeping_neighbours_together_costs_at_most_the_tolerance(
    costs: list[float], workers: int
) -> None:
    problem = Problem(row(costs), grid(1, len(costs)), idle_snapshot(workers))
    bound = (1.0 + problem.rule.tolerance) * (4.0 / 3.0 - 1.0 / (3.0 * workers))
    assert make_plan(problem).placement.makespan_s <= bound * least_makespan_s(problem) + 1e-12


def test_an_excluded_worker_gets_no_shard() -> None:
    plan = make_plan(alone([1.0] * 4, busy(0.0, 0.86, 0.0)))
    assert set(plan.homes) == {0, 2}
    assert [str(reason) for reason in plan.rejections] == ["worker 1: cpu 0.86 > 0.85"]


def test_an_excluded_worker_keeps_the_shards_that_balancing_does_not_move() -> None:
    quiet = BalanceRule(tolerance=5.0)
    problem = replace(alone([1.0] * 4, busy(0.0, 0.86), quiet), present=(0, 0, 1, 1))
    assert make_plan(problem).moves == ()
    nobody = replace(problem, snapshot=busy(0.9, 0.9), rule=STRICT)
    assert make_plan(nobody).homes == (0, 0, 1, 1)
    drained = make_plan(replace(problem, rule=BalanceRule(), present=(0, 1, 1, 1)))
    assert {move.source for move in drained.moves} == {1}


def test_a_fully_used_worker_is_slow_but_its_tick_is_finite() -> None:
    used_up = Candidate(1, Utilisation(1.0, 1.0, 1.0))
    snapshot = LoadSnapshot((*busy(0.0).workers, used_up), "none", "")
    problem = replace(alone([1.0] * 3, snapshot), present=(0, 1, 1))
    plan = make_plan(problem)
    assert math.isfinite(plan.imbalance)
    assert plan.homes == (0, 0, 0)


def test_a_new_worker_gets_shards_round_by_round() -> None:
    plan = make_plan(alone([1.0] * 12, idle_snapshot(2)))
    for _ in range(3):
        plan = make_plan(replace(plan.problem, snapshot=idle_snapshot(3), present=plan.homes))
    assert sorted(plan.homes.count(worker) for worker in range(3)) == [4, 4, 4]


def test_all_shards_of_a_lost_worker_are_placed_despite_the_limit_of_moves() -> None:
    rule = BalanceRule(max_moves=1)
    problem = replace(alone([1.0] * 6, idle_snapshot(2), rule), present=(0, 0, 7, 7, 7, 7))
    plan = make_plan(problem)
    assert set(plan.homes) == {0, 1}
    assert plan.imbalance == 1.0
    assert {move.source for move in plan.moves} == {7}
    gone = LoadSnapshot((Candidate(0, Utilisation(0.0, 0.0), available=False),), "none", "")
    with pytest.raises(NoAdmissibleWorkerError, match="worker 0 is unavailable"):
        make_plan(replace(problem, snapshot=gone))


def test_no_shard_moves_if_the_imbalance_is_within_the_tolerance() -> None:
    problem = replace(alone([1.0, 1.0, 1.0, 1.15], idle_snapshot(2)), present=(0, 0, 1, 1))
    assert make_plan(problem).moves == ()


@settings(deadline=None)
@given(
    st.lists(COSTS, min_size=4, max_size=12), st.integers(1, 5), st.randoms(use_true_random=False)
)
def test_rounds_with_constant_loads_improve_the_plan_until_no_shard_moves(
    costs: list[float], most: int, draw: random.Random
) -> None:
    snapshot = idle_snapshot(3)
    homes = tuple(draw.randrange(3) for _ in costs)
    problem = replace(alone(costs, snapshot, BalanceRule(max_moves=most)), present=homes)
    excess_s = math.inf
    for _ in range(40):
        plan = make_plan(problem)
        assert len(plan.moves) <= most
        if not plan.moves:
            break
        assert plan.placement.excess_s() < excess_s
        excess_s = plan.placement.excess_s()
        problem = replace(problem, present=plan.homes)
    assert make_plan(problem).moves == ()


def test_noise_in_the_costs_moves_no_shard() -> None:
    draw = random.Random(1)
    plan = make_plan(alone([1.0] * 12, idle_snapshot(3)))
    moves = 0
    for _ in range(200):
        costs = [draw.uniform(0.9, 1.1) for _ in range(12)]
        plan = _next(plan, costs)
        moves += len(plan.moves)
    assert moves == 0


def test_an_alternating_load_moves_no_shards() -> None:
    smooth = SmoothCosts(newest=0.1)
    plan = make_plan(alone([1.0] * 8, idle_snapshot(2)))
    moves = []
    for round_ in range(100):
        heavy = (round_ % 2) * 4
        costs = [1.5 if heavy <= zone < heavy + 4 else 1.0 for zone in range(8)]
        means = smooth.update(ShardCost(0, zone, cost) for zone, cost in enumerate(costs))
        plan = _next(plan, [shard.cost_s for shard in means])
        moves.append(len(plan.moves))
    assert sum(moves[20:]) == 0


def _next(plan: Plan, costs: list[float]) -> Plan:
    return make_plan(replace(plan.problem, shards=row(costs), present=plan.homes))


def test_zones_with_a_lasting_jam_are_divided_among_workers() -> None:
    plan = make_plan(Problem(row([1.0] * 16), grid(4, 4), idle_snapshot(4)))
    jam = [8.0 if zone in (0, 1, 4, 5) else 1.0 for zone in range(16)]
    rounds = [plan := _next(plan, jam) for _ in range(10)]
    assert rounds[-1].imbalance < 1.15
    assert all(len(found.moves) <= BalanceRule().max_moves for found in rounds)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"shards": ()}, "no shards"),
        ({"shards": row([1.0, math.nan])}, "zone 1: cost_s = nan"),
        ({"shards": row([1.0, -1.0])}, "zone 1: cost_s = -1"),
        ({"shards": row([1.0, math.inf])}, "zone 1: cost_s = inf"),
        ({"shards": row([1.0, 1.0, 1.0])}, "zone 2: the zone must be below 2"),
        ({"shards": (*row([1.0]), *row([2.0]))}, "world 0, zone 0: is repeated"),
        ({"snapshot": idle_snapshot(3)}, "3 workers for 2 shards"),
        ({"present": (0,)}, "1 present workers of 2 shards"),
    ],
)
def test_invalid_problems_are_refused(change: dict[str, object], said: str) -> None:
    problem = Problem(row([1.0, 1.0]), ((1,), (0,)), idle_snapshot(2))
    with pytest.raises(ConfigError, match=said):
        replace(problem, **change)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ({"tolerance": -0.1}, "tolerance = -0.1"),
        ({"tolerance": math.nan}, "tolerance = nan"),
        ({"max_moves": 0}, "max_moves = 0"),
    ],
)
def test_invalid_rules_are_refused(rule: dict[str, float], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        BalanceRule(**rule)  # type: ignore[arg-type]


def test_weights_change_the_distribution() -> None:
    full = LoadSnapshot(
        (Candidate(0, Utilisation(0.0, 0.8)), Candidate(1, Utilisation(0.4, 0.0))), "none", ""
    )
    by_cpu = BalanceRule(LoadRule((1.0, 0.0, 0.0)))
    by_ram = BalanceRule(LoadRule((0.0, 1.0, 0.0)))
    first, second = (make_plan(alone([1.0] * 10, full, rule)) for rule in (by_cpu, by_ram))
    assert first.homes.count(0) > 5 > second.homes.count(0)


@pytest.mark.parametrize("newest", [0.0, 1.1, math.nan])
def test_an_invalid_smoothing_weight_is_refused(newest: float) -> None:
    with pytest.raises(ConfigError, match="newest"):
        SmoothCosts(newest)
