"""The part of each worker: whole worlds, or zones of one world."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

from cavmarl.balance.balance_plan import Plan, make_plan
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.balance.problem import BalanceRule, Problem, ShardCost, equal_costs
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import World
from cavmarl.zones.partition.zone_statistics import zone_statistics

_EMPTY_KM = 0.01  # cost of a zone without lanes, since each tick visits it
_EQUAL = "number"
_LANES = "length of lanes"


class Part(NamedTuple):
    """The part of one team of workers; most teams are a single worker."""

    first: int  # first world
    last: int  # number after the last world; a team of several workers has one world
    zones: list[list[int]]  # zones of each worker

    @property
    def names(self) -> list[str]:
        """Description of the part of each worker."""
        if self.last - self.first > 1:
            return [f"worlds {self.first} to {self.last - 1}"]
        if len(self.zones) == 1:
            return [f"world {self.first}"]
        return [
            f"world {self.first}, {'zone' if len(zones) == 1 else 'zones'} "
            f"{', '.join(map(str, zones))}"
            for zones in self.zones
        ]


def make_plans(
    world: World,
    num_worlds: int,
    workers: int,  # number of workers, at least 1
    snapshot: LoadSnapshot | None = None,  # how busy workers are; None: all are idle
    rule: BalanceRule | None = None,
) -> list[Plan]:  # one plan of all worlds, or one plan of the zones of each world
    """Distribute worlds evenly over workers; divide worlds if there are more workers than worlds.

    Raises:
        ConfigError: there are more workers than zones of all worlds.
        NoAdmissibleWorkerError: workers are too busy.
    """
    count = world.partition.count
    if workers > count * num_worlds:
        raise ConfigError(
            f"workers = {workers}: {num_worlds} world(s) of {count} zone(s) each can use at most "
            f"{count * num_worlds} workers; use fewer workers, more zones or more worlds"
        )
    seen, rule = snapshot or idle_snapshot(workers), rule or BalanceRule()
    if workers <= num_worlds:
        whole = equal_costs(num_worlds, 1)
        problem = Problem(whole, ((),), seen, rule, in_row=True, cost_source=_EQUAL)
        return [make_plan(problem)]
    firsts = [workers * n // num_worlds for n in range(num_worlds + 1)]
    return [
        _of_zones(world, number, replace(seen, workers=seen.workers[first:last]), rule)
        for number, (first, last) in enumerate(pairwise(firsts))
    ]


def parts_of(plans: Sequence[Plan], num_zones: int) -> list[Part]:
    """Return the part of each team."""
    parts = []
    for plan in plans:
        numbers = [candidate.worker for candidate in plan.problem.snapshot.workers]
        if plan.problem.in_row:
            ends = [bisect_left(plan.homes, number) for number in (*numbers, numbers[-1] + 1)]
            zones = list(range(num_zones))
            parts += [Part(first, last, [zones]) for first, last in pairwise(ends)]
            continue
        world = plan.problem.shards[0].world
        hosted = [[z for z, home in enumerate(plan.homes) if home == k] for k in numbers]
        parts.append(Part(world, world + 1, hosted))
    return parts


def _of_zones(world: World, number: int, seen: LoadSnapshot, rule: BalanceRule) -> Plan:
    """Distribute the zones of a world by length of lanes, neighbours together."""
    partition = world.partition
    lane_km = zone_statistics(partition, world.network).lane_km
    costs = tuple(ShardCost(number, zone, km + _EMPTY_KM) for zone, km in enumerate(lane_km))
    problem = Problem(costs, partition.side_neighbors, seen, rule, cost_source=_LANES)
    plan = make_plan(problem)
    hosted = list(plan.homes)
    excluded = {rejection.worker for rejection in plan.rejections}
    for worker in (candidate.worker for candidate in seen.workers):
        if worker not in hosted and worker not in excluded:  # give each worker a zone
            fullest = max(hosted, key=hosted.count)
            hosted[len(hosted) - 1 - hosted[::-1].index(fullest)] = worker
    return make_plan(replace(problem, present=tuple(hosted))) if hosted != [*plan.homes] else plan
