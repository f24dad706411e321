"""Places shards that have no worker yet: the costliest first, or as runs of consecutive shards."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from cavmarl.balance.shard_placement import Placement

HALVINGS = 60  # halvings of an interval; more than a float's precision needs


def assign_longest_first(
    placement: Placement,  # changed and returned
    groups: Iterable[Sequence[int]],  # groups of shards that stay together
) -> Placement:
    """Give each group, the costliest first, to the worker that would finish it first.

    LPT: at most 4/3 - 1/(3m) times the minimum makespan for m equal workers (Graham, SIAM J. Appl.
    Math. 17, 1969), at most twice with different speeds (Gonzalez, Ibarra, Sahni, SIAM J. Comput.
    6, 1977). On a tie, the worker with fewer shards is chosen, then the lower score, then the
    lower number.
    """
    workers, shards = placement.workers, placement.problem.shards
    loads = placement.loads_s().tolist()
    hosted = [len(placement.on(worker)) for worker in range(len(workers))]
    able = [worker for worker, is_open in enumerate(workers.is_open) if is_open]
    priced = [(math.fsum(shards[shard].cost_s for shard in group), group) for group in groups]
    for cost_s, group in sorted(priced, key=lambda entry: (-entry[0], entry[1])):

        def end(worker: int, cost_s: float = cost_s) -> tuple[float, int, float, int]:
            tick_s = (loads[worker] + cost_s) / float(workers.speeds[worker])
            return tick_s, hosted[worker], workers.scores[worker], worker

        best = min(able, key=end)
        loads[best] += cost_s
        hosted[best] += len(group)
        for shard in group:
            placement.homes[shard] = best
    return placement


def divide_chain(
    placement: Placement,  # changed and returned
) -> Placement:
    """Divide the list of all shards into at most one piece of consecutive shards per worker.

    The list is sorted by world and zone. Consecutive zones of a bisection are neighbours, so pieces
    are connected. The division has the minimum makespan: the limit is found by bisection, and each
    worker takes as many shards as fit into the limit (chains on chains; Pinar and Aykanat, J.
    Parallel Distrib. Comput. 64, 2004).
    """
    low, high = 0.0, _longest_s(placement)
    homes = _within(placement, high)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        found = _within(placement, middle)
        if found is None:
            low = middle
        else:
            high, homes = middle, found
    placement.homes[:] = homes or placement.homes
    return placement


def _longest_s(placement: Placement) -> float:
    """Return a limit within which the slowest worker alone could take all shards."""
    workers = placement.workers
    slowest = float(workers.speeds[workers.is_open].min())
    return 2.0 * math.fsum(shard.cost_s for shard in placement.problem.shards) / slowest


def _within(placement: Placement, limit_s: float) -> list[int] | None:
    """Return pieces such that no worker exceeds the limit; None if shards remain."""
    workers = placement.workers
    homes: list[int] = []
    able = iter([worker for worker, is_open in enumerate(workers.is_open) if is_open])
    worker, left_s = -1, -1.0
    for shard in placement.problem.shards:
        while shard.cost_s > left_s:
            worker = next(able, -1)
            if worker < 0:
                return None
            left_s = limit_s * float(workers.speeds[worker])
        left_s -= shard.cost_s
        homes.append(worker)
    return homes
