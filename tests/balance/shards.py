"""Shards and workers for tests of plans."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from hypothesis import strategies as st

from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.problem import Problem, ShardCost

COSTS = st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 0.001, 0.01, 1.0]))


def grid(rows: int, columns: int) -> tuple[tuple[int, ...], ...]:
    """Return the neighbors of each zone in a grid, row by row."""
    places = list(product(range(rows), range(columns)))
    return tuple(
        tuple(n for n, (c, d) in enumerate(places) if abs(a - c) + abs(b - d) == 1)
        for a, b in places
    )


def row(costs: Sequence[float], worlds: int = 1) -> tuple[ShardCost, ...]:
    """Return the shards of `worlds` worlds with equal numbers of zones."""
    zones = len(costs) // worlds
    return tuple(ShardCost(n // zones, n % zones, cost) for n, cost in enumerate(costs))


def busy(*cpus: float) -> LoadSnapshot:
    """Return loads of workers on which other programs use these shares of the processor."""
    workers = tuple(Candidate(n, Utilisation(cpu, 0.0)) for n, cpu in enumerate(cpus))
    return LoadSnapshot(workers, "none", "generated")


def least_makespan_s(problem: Problem) -> float:
    """Return the least makespan of all assignments, if every worker is admissible."""
    speeds = [1.0 - 0.6 * one.use.cpu - 0.2 * one.use.ram for one in problem.snapshot.workers]
    costs = [shard.cost_s for shard in problem.shards]

    def makespan_s(homes: tuple[int, ...]) -> float:
        loads = [0.0] * len(speeds)
        for cost, home in zip(costs, homes, strict=True):
            loads[home] += cost
        return max(load / speed for load, speed in zip(loads, speeds, strict=True))

    return min(map(makespan_s, product(range(len(speeds)), repeat=len(costs))))
