"""`Problem`: the input of a plan: costs, neighbours, workers, rules, present homes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from cavmarl.balance.load_score import LoadRule
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.core.errors import ConfigError

MEASURED_COSTS = "measured"

MAX_COST_S = 1e6  # of a tick: sums stay finite


class ShardCost(NamedTuple):
    """What one shard costs."""

    world: int
    zone: int
    cost_s: float  # seconds a tick, on an otherwise idle processor


def equal_costs(worlds: int, zones: int) -> tuple[ShardCost, ...]:
    """Shards of which nothing has been measured: each counts as much as another."""
    return tuple(ShardCost(world, zone, 1.0) for world in range(worlds) for zone in range(zones))


@dataclass(frozen=True)
class BalanceRule:
    """When shards move, and how many at once."""

    load: LoadRule = field(default_factory=LoadRule)  # how workers are scored and excluded
    # while the slowest worker takes at most this share longer than a perfect division would,
    # nothing moves; a round that gains less than this is not made; and so much may be given up to
    # keep neighbours together
    tolerance: float = 0.1
    # shards that change their worker in one round, those of lost workers not counted
    max_moves: int = 4
    move_s: float = 0.01  # what a move costs, once
    # a round is made only if it saves the workers together that much in so many ticks
    payback_ticks: int = 1000
    keeps_one: bool = False  # a worker's last shard stays with it, or is swapped

    def __post_init__(self) -> None:
        for name in ("tolerance", "move_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ConfigError(f"{name} = {value}: must be a number from 0 up")
        for name in ("max_moves", "payback_ticks"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} = {getattr(self, name)}: must be at least 1")


@dataclass(frozen=True)
class Problem:
    """Everything that a plan follows from; it is put in order, so that no order ever counts."""

    shards: tuple[ShardCost, ...]  # of all worlds, by world and zone
    neighbors: tuple[tuple[int, ...], ...]  # for each zone those that share a side with it
    snapshot: LoadSnapshot  # of the workers
    rule: BalanceRule = field(default_factory=BalanceRule)  # when shards move
    # worker of each shard now, in the order of `shards`; None: none is hosted yet
    present: tuple[int, ...] | None = None
    # the shards of a worker follow each other, workers by their numbers, each with one at least; so
    # it is for worlds whose results lie in one array
    in_row: bool = False
    # where costs come from; if it is not `measured`, they only compare shards
    cost_source: str = MEASURED_COSTS

    def __post_init__(self) -> None:
        _check_shards(self.shards, len(self.neighbors))
        _check_neighbors(self.neighbors)
        workers = len(self.snapshot.workers)
        if workers > len(self.shards):
            raise ConfigError(
                f"{workers} workers for {len(self.shards)} shards: use at most as many workers as "
                "there are shards, or more zones or worlds"
            )
        if self.present is not None and len(self.present) != len(self.shards):
            raise ConfigError(
                f"{len(self.present)} present workers of {len(self.shards)} shards: name one each"
            )
        order = sorted(range(len(self.shards)), key=lambda n: self.shards[n])
        object.__setattr__(self, "shards", tuple(self.shards[n] for n in order))
        if self.present is not None:
            object.__setattr__(self, "present", tuple(self.present[n] for n in order))
        if self.in_row and list(self.present or ()) != sorted(self.present or ()):
            raise ConfigError(f"present workers {self.present}: must be in a row, by number")

    @cached_property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Shards, by their place in `shards`, whose zones share a side in one world."""
        place = {(shard.world, shard.zone): n for n, shard in enumerate(self.shards)}
        return tuple(
            sorted(
                {
                    (n, place[shard.world, zone])
                    for n, shard in enumerate(self.shards)
                    for zone in self.neighbors[shard.zone]
                    if (shard.world, zone) in place and n < place[shard.world, zone]
                }
            )
        )


def _check_shards(shards: Sequence[ShardCost], zones: int) -> None:
    if not shards:
        raise ConfigError("no shards: there must be at least one")
    names = [(shard.world, shard.zone) for shard in shards]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"world {twice[0]}, zone {twice[1]}: is named twice")
    for shard in shards:
        if not 0 <= shard.zone < zones:
            raise ConfigError(
                f"world {shard.world}, zone {shard.zone}: there are neighbours of {zones} zones"
            )
        if not 0.0 <= shard.cost_s <= MAX_COST_S:  # NaN is not, either
            raise ConfigError(
                f"world {shard.world}, zone {shard.zone}: cost_s = {shard.cost_s}: must be "
                f"seconds from 0 to {MAX_COST_S:g}; measure it again"
            )


def _check_neighbors(neighbors: Sequence[Sequence[int]]) -> None:
    for zone, row in enumerate(neighbors):
        for other in row:
            if not (0 <= other < len(neighbors) and zone in neighbors[other] and zone != other):
                raise ConfigError(
                    f"zone {zone} names {other} as its neighbour, which does not name it"
                )
