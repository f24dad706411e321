"""Which worker runs what: whole worlds each, or zones of one world."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

from cavmarl.balance.plan import make_plan
from cavmarl.balance.problem import Problem, ShardCost
from cavmarl.balance.snapshot import idle_snapshot
from cavmarl.errors import ConfigError
from cavmarl.roads.zone_statistics import zone_statistics
from cavmarl.worlds import World

__all__ = ["Part", "share_out"]

# Of a zone in which no lane lies, as a length of lanes: it is looked at in every tick.
_EMPTY_KM = 0.01


class Part(NamedTuple):
    """What the workers of one team run; most teams are one worker.

    Attributes:
        first: world.
        last: the one after the last; where there are several workers it is the next.
        zones: that each worker hosts.
    """

    first: int
    last: int
    zones: list[list[int]]

    @property
    def names(self) -> list[str]:
        """Of what each worker runs, in words."""
        if self.last - self.first > 1:
            return [f"worlds {self.first} to {self.last - 1}"]
        if len(self.zones) == 1:
            return [f"world {self.first}"]
        return [
            f"world {self.first}, {'zone' if len(zones) == 1 else 'zones'} "
            f"{', '.join(map(str, zones))}"
            for zones in self.zones
        ]


def share_out(world: World, num_worlds: int, workers: int) -> list[Part]:
    """Worlds to workers as evenly as may be; those are divided of which there are too few.

    Args:
        world: what each is made of.
        num_worlds: how many there are.
        workers: how many, at least 1.

    Raises:
        ConfigError: more of them than zones of all worlds.
    """
    count = world.partition.count
    if workers > count * num_worlds:
        raise ConfigError(
            f"workers = {workers}: {num_worlds} world(s) of {count} zone(s) each can be shared out "
            f"over at most {count * num_worlds}; use fewer workers, more zones or more worlds"
        )
    parts = min(workers, num_worlds)
    worlds = [num_worlds * n // parts for n in range(parts + 1)]
    sizes = [workers * (n + 1) // parts - workers * n // parts for n in range(parts)]
    zones = {size: _zones(world, size) for size in set(sizes)}
    return [
        Part(first, last, zones[size])
        for (first, last), size in zip(pairwise(worlds), sizes, strict=True)
    ]


def _zones(world: World, workers: int) -> list[list[int]]:
    """The zones of one world to some workers, neighbours together; by length of lanes."""
    partition = world.partition
    everything = list(range(partition.count))
    if workers == 1:
        return [everything]
    lane_km = zone_statistics(partition, world.network).lane_km
    costs = tuple(ShardCost(0, zone, lane_km[zone] + _EMPTY_KM) for zone in everything)
    plan = make_plan(Problem(costs, partition.side_neighbors, idle_snapshot(workers)))
    hosted = [[zone for zone in everything if plan.homes[zone] == k] for k in range(workers)]
    _let_nobody_idle(hosted)
    # The leader has more to do: it takes the lightest part.
    return sorted(hosted, key=lambda zones: math.fsum(costs[zone].cost_s for zone in zones))


def _let_nobody_idle(hosted: list[list[int]]) -> None:
    """Who has nothing takes a zone of the worker that has most."""
    while not all(hosted):
        idle = hosted.index([])
        hosted[idle].append(max(hosted, key=len).pop())
