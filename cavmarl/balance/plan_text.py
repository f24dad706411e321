"""A plan as a table to read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import groupby

from cavmarl.balance.plan import Plan

__all__ = ["describe_plan"]

HEADINGS = (
    "worker",
    "cpu",
    "ram",
    "gpu",
    "score",
    "shards",
    "load, ms",
    "tick, ms",
    "world: zones",
)
LEFT = len(HEADINGS) - 1  # the last column is text


def describe_plan(plan: Plan) -> str:
    """Lines without a last line break: the whole, each worker, who is excluded, who moves."""
    problem, placement = plan.problem, plan.placement
    snapshot = problem.snapshot
    costs = [shard.cost_s for shard in problem.shards]
    weights = " + ".join(
        f"{weight:g} {name}"
        for weight, name in zip(problem.rule.load.weights, ("CPU", "RAM", "GPU"), strict=True)
    )
    lines = [
        f"{len(problem.shards)} shards on {len(snapshot.workers)} workers, {plan.method}",
        f"slowest worker {1e3 * placement.makespan_s:.3f} ms a tick, "
        f"{plan.imbalance:.3f} times a perfect division; "
        f"neighbours apart: {placement.cut_pairs} of {len(problem.pairs)}",
        f"costliest shard {1e3 * max(costs):.3f} ms a tick, {_over_mean(costs):.3f} times the mean",
        f"score = {weights}; workers {snapshot.origin}, GPU: {snapshot.gpu_source}",
        "",
        *_table(HEADINGS, _rows(plan)),
        *(f"excluded: {rejection}" for rejection in plan.rejections),
    ]
    if problem.present is not None:
        lines.append(f"moves: {len(plan.moves)}")
        lines += [
            f"  world {move.world}, zone {move.zone}: worker {move.source} → {move.target}"
            for move in plan.moves
        ]
    return "\n".join(lines)


def _over_mean(costs: Sequence[float]) -> float:
    """The imbalance that zones would have with a worker each."""
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
            f"{1e3 * worker.load_s:.3f}",
            f"{1e3 * worker.tick_s:.3f}",
            _named(names),
        )


def _named(names: Sequence[tuple[int, int]]) -> str:
    """`0: 0-3 5; 1: 0`: zones of each world, runs as ranges."""
    worlds = []
    for world, members in groupby(names, lambda name: name[0]):
        zones = [zone for _, zone in members]
        runs = [
            [zone for _, zone in run]
            for _, run in groupby(enumerate(zones), lambda entry: entry[1] - entry[0])
        ]
        said = " ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
        worlds.append(f"{world}: {said}")
    return "; ".join(worlds)


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
