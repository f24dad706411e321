"""Assigns the shards of all worlds to workers, for the first plan and for later plans."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from cavmarl.balance.contiguous_split import divide_row, shift_ends
from cavmarl.balance.initial_placement import assign_longest_first, divide_chain
from cavmarl.balance.load_score import Candidate, Rejection, admissible, find_rejections
from cavmarl.balance.local_search import refine
from cavmarl.balance.problem import Problem
from cavmarl.balance.shard_placement import Placement, Workers


def workers_of(problem: Problem) -> tuple[Workers, tuple[Rejection, ...]]:
    """Return the workers that answer, and the reasons for which workers are excluded."""
    candidates: Sequence[Candidate] = problem.snapshot.workers
    rejections = find_rejections(candidates, problem.rule.load)
    answering = [candidate for candidate in candidates if candidate.available]
    return Workers(answering, rejections, problem.rule.load.weights), rejections


def assign(problem: Problem) -> tuple[Placement, str]:
    """Place all shards, or move some of them; return the placement and a short description.

    Shards without an answering worker go to the worker that finishes them first. Of the other
    shards, at most `max_moves` move, and only if the slowest worker exceeds a perfect division
    (`fair_s`) by more than the tolerance. The gain per tick must be at least the tolerance times
    `fair_s`, and must repay the time of the moves within `payback_ticks`. An excluded worker keeps
    its shards until balancing moves them.

    Raises:
        NoAdmissibleWorkerError: shards need a place, and all workers are excluded; with
            `problem.in_row`, also if any worker is excluded.
    """
    workers, rejections = workers_of(problem)
    if problem.present is None:
        admissible(problem.snapshot.workers, rejections)
        return _place(problem, workers)
    place = {number: n for n, number in enumerate(workers.numbers)}
    placement = Placement(problem, workers, [place.get(home, -1) for home in problem.present])
    lost = [shard for shard, home in enumerate(placement.homes) if home < 0]
    if lost:
        admissible(problem.snapshot.workers, rejections)
        if problem.in_row:
            return _place(problem, workers)
        assign_longest_first(placement, [[shard] for shard in lost])
    return _rebalance(placement, "shards of lost workers placed" if lost else "unchanged")


def _place(problem: Problem, workers: Workers) -> tuple[Placement, str]:
    """Of several placements, return the one that separates the fewest neighbours.

    Placements that are slower than `longest` by more than the tolerance are left out.
    """
    shards = range(len(problem.shards))
    nowhere = Placement(problem, workers, [-1 for _ in shards])
    if problem.in_row:
        return divide_row(nowhere), "all in a row"
    worlds = [list(part) for _, part in groupby(shards, lambda n: problem.shards[n].world)]
    longest = refine(assign_longest_first(nowhere.copy(), [[shard] for shard in shards]))
    if not longest.fair_s:
        return longest, "evenly by number: no shard costs anything"
    limit_s = longest.makespan_s * (1.0 + problem.rule.tolerance)
    slack_s = _slack_s(longest)
    whole, row = assign_longest_first(nowhere.copy(), worlds), divide_chain(nowhere.copy())
    ways = [
        (whole, "worlds whole"),
        (row, "neighbours in a row"),
        (
            refine(whole.copy(), until_s=limit_s, slack_s=slack_s),
            "worlds whole, except a few shards",
        ),
        (
            refine(row.copy(), until_s=limit_s, slack_s=slack_s),
            "neighbours in a row, except a few shards",
        ),
        (longest, "costliest shards first"),
    ]
    good = [way for way in ways if way[0].makespan_s <= limit_s]
    return min(good, key=lambda way: (way[0].cut_pairs, way[0].makespan_s))


def _rebalance(placement: Placement, method: str) -> tuple[Placement, str]:
    rule = placement.problem.rule
    if placement.imbalance <= 1.0 + rule.tolerance:
        return placement, method
    slack_s = _slack_s(placement)
    until_s = placement.fair_s + slack_s
    if placement.problem.in_row:
        moved = shift_ends(placement.copy(), until_s=until_s, max_moves=rule.max_moves)
    else:
        moved = refine(placement.copy(), until_s=until_s, slack_s=slack_s, max_moves=rule.max_moves)
    gain_s = placement.excess_s() - moved.excess_s()
    moves = sum(one != other for one, other in zip(placement.homes, moved.homes, strict=True))
    price_s = max(rule.tolerance * placement.fair_s, moves * rule.move_s / rule.payback_ticks)
    if gain_s > 0.0 and gain_s >= price_s:
        return moved, "moved from the slowest"
    return placement, method


def _slack_s(placement: Placement) -> float:
    """Return how much longer than ideal a tick may be, in order to keep neighbours together."""
    return 0.5 * placement.problem.rule.tolerance * placement.fair_s
