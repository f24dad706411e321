"""`Problem`: the input of a plan: costs, neighbours, workers, rules, current homes."""

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

MAX_COST_S = 1e6  # limit of a cost per tick, which keeps sums finite


class ShardCost(NamedTuple):
    """The cost of one shard."""

    world: int
    zone: int
    cost_s: float  # s per tick on an otherwise idle processor


def equal_costs(worlds: int, zones: int) -> tuple[ShardCost, ...]:
    """Return equal costs for all shards, for use before anything has been measured."""
    return tuple(ShardCost(world, zone, 1.0) for world in range(worlds) for zone in range(zones))


@dataclass(frozen=True)
class BalanceRule:
    """When shards move, and how many at once."""

    load: LoadRule = field(default_factory=LoadRule)  # how workers are scored and excluded
    # share of a perfect division's tick. Shards move only if the slowest worker exceeds a perfect
    # division by more than this share, and if the gain exceeds this share. To keep neighbours
    # together, a tick may be longer by this share.
    tolerance: float = 0.1
    # maximum number of shards that move in a round, not counting shards of lost workers
    max_moves: int = 4
    move_s: float = 0.01  # s, cost of one move
    # shards move only if all workers together save the cost of the moves within this many ticks
    payback_ticks: int = 1000
    keeps_one: bool = False  # whether a worker's last shard may only be swapped

    def __post_init__(self) -> None:
        for name in ("tolerance", "move_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ConfigError(f"{name} = {value}: must be a number of at least 0")
        for name in ("max_moves", "payback_ticks"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} = {getattr(self, name)}: must be at least 1")


@dataclass(frozen=True)
class Problem:
    """The complete input of a plan, sorted so that the order of arguments has no effect."""

    shards: tuple[ShardCost, ...]  # all worlds, sorted by world and zone
    neighbors: tuple[tuple[int, ...], ...]  # zones that share a side with each zone
    snapshot: LoadSnapshot  # load of the workers
    rule: BalanceRule = field(default_factory=BalanceRule)  # rules for moving shards
    # current worker of each shard, in the order of `shards`; None: none is placed yet
    present: tuple[int, ...] | None = None
    # whether each worker must host one or more consecutive shards, in the order of workers, because
    # the results of all worlds are in one array
    in_row: bool = False
    # source of the costs; unless it is `measured`, only their ratios count
    cost_source: str = MEASURED_COSTS

    def __post_init__(self) -> None:
        _check_shards(self.shards, len(self.neighbors))
        _check_neighbors(self.neighbors)
        workers = len(self.snapshot.workers)
        if workers > len(self.shards):
            raise ConfigError(
                f"{workers} workers for {len(self.shards)} shards; use at most as many workers as "
                "there are shards, or more zones or worlds"
            )
        if self.present is not None and len(self.present) != len(self.shards):
            raise ConfigError(
                f"{len(self.present)} present workers of {len(self.shards)} shards; "
                "give one for each shard"
            )
        order = sorted(range(len(self.shards)), key=lambda n: self.shards[n])
        object.__setattr__(self, "shards", tuple(self.shards[n] for n in order))
        if self.present is not None:
            object.__setattr__(self, "present", tuple(self.present[n] for n in order))
        if self.in_row and list(self.present or ()) != sorted(self.present or ()):
            raise ConfigError(f"present workers {self.present}: must be ascending")

    @cached_property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs of shards, by index in `shards`, whose zones share a side in one world."""
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
        raise ConfigError("there are no shards; define at least one")
    names = [(shard.world, shard.zone) for shard in shards]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"world {twice[0]}, zone {twice[1]}: is repeated; name each shard once")
    for shard in shards:
        if not 0 <= shard.zone < zones:
            raise ConfigError(
                f"world {shard.world}, zone {shard.zone}: the zone must be below {zones}"
            )
        if not 0.0 <= shard.cost_s <= MAX_COST_S:  # NaN also fails this check
            raise ConfigError(
                f"world {shard.world}, zone {shard.zone}: cost_s = {shard.cost_s}: must be "
                f"seconds from 0 to {MAX_COST_S:g}; measure it again"
            )


def _check_neighbors(neighbors: Sequence[Sequence[int]]) -> None:
    for zone, row in enumerate(neighbors):
        for other in row:
            if not (0 <= other < len(neighbors) and zone in neighbors[other] and zone != other):
                raise ConfigError(
                    f"zone {zone} names {other} as its neighbour, but {other} does not name {zone}"
                )
