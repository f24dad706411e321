"""Shards in a row: each worker hosts a piece of it, and the ends of pieces slide."""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np

from cavmarl.balance.load_score import find_rejections
from cavmarl.balance.local_search import LEAST_GAIN
from cavmarl.balance.shard_placement import Placement
from cavmarl.core.errors import NoAdmissibleWorkerError


def divide_row(
    placement: Placement,  # it is changed, and returned
) -> Placement:
    """Cut the row into one piece a worker, as long as its speed; one shard at least."""
    problem, workers = placement.problem, placement.workers
    if not workers.is_open.all():
        rejections = find_rejections(problem.snapshot.workers, problem.rule.load)
        raise NoAdmissibleWorkerError(
            f"{'; '.join(map(str, rejections))}: in a row each worker hosts one shard at least; "
            "use fewer workers, or wait until they are less busy",
            rejections,
        )
    costs = [shard.cost_s for shard in problem.shards]
    costs = costs if any(costs) else [1.0 for _ in costs]  # nothing costs anything: all as much
    ends = np.array([0.0, *accumulate(costs)])
    shares = np.cumsum(workers.speeds) / workers.speeds.sum()
    first, count = 0, len(workers)
    for worker, share in enumerate(shares.tolist()):
        last = int(np.abs(ends - share * ends[-1]).argmin())
        last = min(max(last, first + 1), len(costs) - (count - 1 - worker))
        placement.homes[first:last] = [worker] * (last - first)
        first = last
    return placement


def slide(
    placement: Placement,  # it is changed, and returned
    *,
    until_s: float,  # a makespan that is good enough
    max_moves: int,  # of shards
) -> Placement:
    """Let the slowest worker's piece become shorter, again and again.

    It gives the shard at one of its ends to the worker beside it; that one may give one on to the
    next, and so forth, until all of them take less long than the slowest took. Of these changes
    the one after which they take least is made, of equal ones the one that moves fewer shards.
    """
    left = max_moves
    while left > 0 and placement.makespan_s > until_s:
        ticks = placement.ticks_s()
        source = int(ticks.argmax())
        found: list[tuple[float, int, int, list[int]]] = []
        for step in (-1, 1):
            homes = list(placement.homes)
            for moves, giver in enumerate(_towards(source, step, len(ticks)), start=1):
                if moves > left or not _give(placement, homes, giver, step):
                    break
                worst_s = _worst_s(placement, homes, source, giver + step)
                found.append((worst_s, moves, step, list(homes)))
        if not found:
            break
        worst_s, moves, _, homes = min(found)
        if worst_s >= ticks[source] * (1.0 - LEAST_GAIN):
            break
        placement.homes[:] = homes
        left -= moves
    return placement


def _towards(source: int, step: int, count: int) -> range:
    """Workers that would give one on, from the source to the last but one in that direction."""
    return range(source, count - 1) if step > 0 else range(source, 0, -1)


def _give(placement: Placement, homes: list[int], giver: int, step: int) -> bool:
    """Give the shard at one end of a piece to the next worker; False: that cannot be."""
    taker = giver + step
    if homes.count(giver) < 2 or not placement.workers.is_open[taker]:
        return False
    last = len(homes) - 1 - homes[::-1].index(giver)
    homes[last if step > 0 else homes.index(giver)] = taker
    return True


def _worst_s(placement: Placement, homes: list[int], first: int, last: int) -> float:
    shards, speeds = placement.problem.shards, placement.workers.speeds
    between = range(min(first, last), max(first, last) + 1)
    return max(
        math.fsum(shard.cost_s for shard, home in zip(shards, homes, strict=True) if home == worker)
        / float(speeds[worker])
        for worker in between
    )
