"""Placement of consecutive shards: each worker hosts one piece of the list of shards.

Later rounds of balancing move the ends of pieces.
"""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np

from cavmarl.balance.load_score import find_rejections
from cavmarl.balance.local_search import LEAST_GAIN
from cavmarl.balance.shard_placement import Placement
from cavmarl.core.errors import NoAdmissibleWorkerError


def divide_row(
    placement: Placement,  # changed and returned
) -> Placement:
    """Cut the list of shards into one piece per worker, sized by its speed; no piece is empty."""
    problem, workers = placement.problem, placement.workers
    if not workers.is_open.all():
        rejections = find_rejections(problem.snapshot.workers, problem.rule.load)
        raise NoAdmissibleWorkerError(
            f"{'; '.join(map(str, rejections))}: each worker must host at least one shard; "
            "use fewer workers, or wait until they are less busy",
            rejections,
        )
    costs = [shard.cost_s for shard in problem.shards]
    costs = costs if any(costs) else [1.0 for _ in costs]  # without costs, all shards are equal
    ends = np.array([0.0, *accumulate(costs)])
    shares = np.cumsum(workers.speeds) / workers.speeds.sum()
    first, count = 0, len(workers)
    for worker, share in enumerate(shares.tolist()):
        last = int(np.abs(ends - share * ends[-1]).argmin())
        last = min(max(last, first + 1), len(costs) - (count - 1 - worker))
        placement.homes[first:last] = [worker] * (last - first)
        first = last
    return placement


def shift_ends(
    placement: Placement,  # changed and returned
    *,
    until_s: float,  # a makespan that is good enough
    max_moves: int,  # maximum number of moved shards
) -> Placement:
    """Shorten the piece of the slowest worker repeatedly.

    The slowest worker gives the shard at one of its ends to the adjacent worker. That worker may
    pass a shard on to the next worker, and so on, until each is faster than the slowest worker was.
    The change with the shortest makespan is made; on a tie, the change with the fewest moves.
    """
    left = max_moves
    while left > 0 and placement.makespan_s > until_s:
        ticks = placement.ticks_s()
        source = int(ticks.argmax())
        found: list[tuple[float, int, int, list[int]]] = []
        for step in (-1, 1):
            homes = list(placement.homes)
            for moves, giver in enumerate(_towards(source, step, len(ticks)), start=1):
                if moves > left or not _pass_to_next(placement, homes, giver, step):
                    break
                worst_s = _slowest_s(placement, homes, source, giver + step)
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
    """Return the workers that may pass a shard on in a direction, starting with `source`."""
    return range(source, count - 1) if step > 0 else range(source, 0, -1)


def _pass_to_next(placement: Placement, homes: list[int], giver: int, step: int) -> bool:
    """Give the shard at one end of a piece to the next worker; return whether this is allowed."""
    taker = giver + step
    if homes.count(giver) < 2 or not placement.workers.is_open[taker]:
        return False
    last = len(homes) - 1 - homes[::-1].index(giver)
    homes[last if step > 0 else homes.index(giver)] = taker
    return True


def _slowest_s(placement: Placement, homes: list[int], first: int, last: int) -> float:
    shards, speeds = placement.problem.shards, placement.workers.speeds
    between = range(min(first, last), max(first, last) + 1)
    return max(
        math.fsum(shard.cost_s for shard, home in zip(shards, homes, strict=True) if home == worker)
        / float(speeds[worker])
        for worker in between
    )
