"""Improves a plan by moves and swaps that make the slowest worker faster."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.problem import Problem
from cavmarl.balance.shard_placement import Placement

Floats = NDArray[np.float64]
LEAST_GAIN = 1e-9  # minimum gain as a share of a tick; smaller differences may be rounding errors
MOVES_A_SHARD = 4  # safety limit of moves per shard; not reached, since every change saves time


def refine(
    placement: Placement,  # changed and returned
    *,
    until_s: float = 0.0,  # a makespan that is good enough
    # a change that separates fewer neighbours is preferred to the fastest change, if this makes the
    # makespan longer by at most `slack_s`
    slack_s: float = 0.0,
    max_moves: int | None = None,  # limit of moved shards; a swap counts as two. None: no limit
) -> Placement:
    """Move shards off the slowest worker, or swap them with other workers' shards, while it helps.

    A change helps if it makes both workers faster than the slowest worker was. No shard moves to an
    excluded worker. If the rule `keeps_one` is set, no worker loses its last shard.
    """
    left = MOVES_A_SHARD * len(placement.homes) if max_moves is None else max_moves
    touching = _touching(placement.problem)
    while left > 0 and placement.makespan_s > until_s:
        change = _best_change(placement, touching, slack_s, may_swap=left > 1)
        if change is None:
            break
        shard, other, target = change
        if other is not None:
            placement.homes[other] = placement.homes[shard]
        placement.homes[shard] = target
        left -= 1 if other is None else 2
    return placement


def _touching(problem: Problem) -> NDArray[np.int64]:
    """Return (n, n), which is 1 where two shards are neighbours."""
    touching = np.zeros((len(problem.shards), len(problem.shards)), dtype=np.int64)
    for a, b in problem.pairs:
        touching[a, b] = touching[b, a] = 1
    return touching


def _best_change(
    placement: Placement, touching: NDArray[np.int64], slack_s: float, *, may_swap: bool
) -> tuple[int, int | None, int] | None:
    """Return (shard of the slowest worker, its swap partner, its new worker), or None."""
    workers = placement.workers
    homes, count = np.array(placement.homes), len(workers)
    costs = np.array([shard.cost_s for shard in placement.problem.shards])
    loads, ticks = placement.loads_s(), placement.ticks_s()
    source = int(ticks.argmax())
    own = np.flatnonzero(homes == source)
    others = np.flatnonzero(homes != source)
    if not (may_swap and workers.is_open[source]):
        others = others[:0]
    # Columns: a move to each worker, then a swap with each other shard. `back` is the cost of the
    # shard that the slowest worker receives in return.
    targets = np.concatenate([np.arange(count), homes[others]])
    back = np.concatenate([np.zeros(count), costs[others]])
    change = costs[own][:, None] - back[None, :]
    worst = np.maximum(
        (loads[source] - change) / workers.speeds[source],
        (loads[targets] + change) / workers.speeds[targets],
    )
    worst[:, ~workers.is_open[targets] | (targets == source)] = math.inf
    if placement.problem.rule.keeps_one and len(own) == 1:
        worst[:, :count] = math.inf
    if not worst.size or not worst.min() < ticks[source] * (1.0 - LEAST_GAIN):
        return None
    limit_s = min(worst.min() + slack_s, ticks[source] * (1.0 - LEAST_GAIN))
    near = touching @ (homes[:, None] == np.arange(count)).astype(np.int64)
    cut = _more_cut(near, touching, own, others, source, targets)
    rows, columns = np.nonzero(worst <= limit_s)
    best = np.lexsort((columns, rows, worst[rows, columns], cut[rows, columns]))[0]
    row, column = int(rows[best]), int(columns[best])
    other = None if column < count else int(others[column - count])
    return int(own[row]), other, int(targets[column])


def _more_cut(
    near: NDArray[np.int64],  # (n, m) neighbours of each shard on each worker
    touching: NDArray[np.int64],  # (n, n) 1 where two shards are neighbours
    own: NDArray[np.int64],  # shards of the source
    others: NDArray[np.int64],  # shards that can be received in a swap; they are the last columns
    source: int,  # the giving worker
    targets: NDArray[np.int64],  # the receiving worker of each column
) -> NDArray[np.int64]:
    """Return how many more pairs of neighbours each change separates, (own, targets)."""
    cut = near[own, source][:, None] - near[own][:, targets]
    first = len(targets) - len(others)
    homes = targets[first:]
    cut[:, first:] += (near[others, homes] - near[others, source])[None, :]
    # Two neighbours that are swapped stay separated.
    cut[:, first:] += 2 * touching[np.ix_(own, others)]
    return np.asarray(cut)
