"""A plan as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import groupby

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.problem import MEASURED_COSTS

HEADINGS = ("worker", "cpu", "ram", "gpu", "score", "shards", "load", "tick", "hosts")
LEFT = len(HEADINGS) - 1  # the last column is text


def describe_plan(plan: Plan) -> str:
    """Return lines for a terminal: the summary, each worker, excluded workers, moves."""
    problem, placement = plan.problem, plan.placement
    snapshot = problem.snapshot
    costs = [shard.cost_s for shard in problem.shards]
    weights = " + ".join(
        f"{weight:g} {name}"
        for weight, name in zip(problem.rule.load.weights, ("CPU", "RAM", "GPU"), strict=True)
    )
    what = "worlds" if problem.in_row else "shards"
    unit = " ms a tick" if _is_measured(plan) else ""
    headings = [
        {"shards": what, "hosts": what if problem.in_row else "world: zones"}.get(name, name)
        + (", ms" if unit and name in ("load", "tick") else "")
        for name in HEADINGS
    ]
    lines = [
        f"{len(problem.shards)} {what} on {len(snapshot.workers)} workers, {plan.method}"
        + ("" if unit else f"; costs by {problem.cost_source}"),
        f"slowest worker {_cost(plan, placement.makespan_s)}{unit}, "
        f"{plan.imbalance:.3f} times a perfect division; "
        f"separated neighbours: {placement.cut_pairs} of {len(problem.pairs)}",
        f"costliest {what[:-1]} {_cost(plan, max(costs))}{unit}, "
        f"{_over_mean(costs):.3f} times the mean",
        f"score = {weights}; workers {snapshot.origin}, GPU: {snapshot.gpu_source}",
        "",
        *_table(headings, _rows(plan)),
        *(f"excluded: {rejection}" for rejection in plan.rejections),
    ]
    if problem.present is not None:
        lines.append(f"moves: {len(plan.moves)}")
        lines += [
            f"  world {move.world}{'' if problem.in_row else f', zone {move.zone}'}: "
            f"worker {move.source} → {move.target}"
            for move in plan.moves
        ]
    return "\n".join(lines)


def _is_measured(plan: Plan) -> bool:
    return plan.problem.cost_source == MEASURED_COSTS


def _cost(plan: Plan, cost_s: float) -> str:
    """Format a measured cost in ms; other costs have no unit, because only ratios count."""
    return f"{1e3 * cost_s if _is_measured(plan) else cost_s:.3f}"


def _over_mean(costs: Sequence[float]) -> float:
    total = math.fsum(costs)
    return max(costs) * len(costs) / total if total else 1.0


def _rows(plan: Plan) -> Iterable[tuple[str, ...]]:
    uses = {candidate.worker: candidate.use for candidate in plan.problem.snapshot.workers}
    for worker in plan.workers():
        use = uses[worker.worker]
        names = [
            (shard.world, shard.zone)
            for shard, home in zip(plan.problem.shards, plan.homes, strict=True)
            if home == worker.worker
        ]
        yield (
            str(worker.worker),
            *(f"{share:.2f}" for share in (use.cpu, use.ram, use.gpu)),
            f"{worker.score:.3f}",
            str(worker.shards),
            _cost(plan, worker.load_s),
            _cost(plan, worker.tick_s),
            _runs([world for world, _ in names]) if plan.problem.in_row else _named(names),
        )


def _named(names: Sequence[tuple[int, int]]) -> str:
    """Format zones of each world, runs as ranges: `0: 0-3 5; 1: 0`."""
    worlds = []
    for world, members in groupby(names, lambda name: name[0]):
        worlds.append(f"{world}: {_runs([zone for _, zone in members])}")
    return "; ".join(worlds)


def _runs(numbers: Sequence[int]) -> str:
    """Format numbers, runs as ranges: `0-3 5`."""
    runs = [
        [number for _, number in run]
        for _, run in groupby(enumerate(numbers), lambda entry: entry[1] - entry[0])
    ]
    return " ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    cells = [tuple(headings), *rows]
    widths = [max(len(row[column]) for row in cells) for column in range(len(headings))]
    return [
        "  ".join(
            cell.ljust(width) if column == LEFT else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
