"""`Plan`: which worker hosts which shard, and its inputs."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

from cavmarl.balance.assignment import assign, workers_of
from cavmarl.balance.load_score import Rejection
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.problem import Problem
from cavmarl.balance.shard_placement import Placement
from cavmarl.core.errors import ConfigError

SCHEMA = "cavmarl.plan"
VERSION = 1


class ShardMove(NamedTuple):
    """A shard that changes its worker."""

    world: int
    zone: int
    source: int  # where it was
    target: int  # where it goes


class WorkerLoad(NamedTuple):
    """What a plan makes of a worker that answers."""

    worker: int
    score: float  # its LoadScore before
    shards: int  # how many it hosts
    load_s: float  # what they cost, seconds a tick
    tick_s: float  # how long it takes for them beside what others use of it


@dataclass(frozen=True)
class Plan:
    """A placement, reproducible: `make_plan(plan.problem) == plan`."""

    problem: Problem  # what it follows from
    homes: tuple[int, ...]  # worker of each shard, in the order of `problem.shards`
    method: str  # how it was found, in words

    def __post_init__(self) -> None:
        answering = {one.worker for one in self.problem.snapshot.workers if one.available}
        if len(self.homes) != len(self.problem.shards) or not answering.issuperset(self.homes):
            raise ConfigError(
                f"homes {self.homes}: must be one a shard of {len(self.problem.shards)}, among "
                f"the workers that answer, {sorted(answering)}"
            )

    @cached_property
    def rejections(self) -> tuple[Rejection, ...]:
        return workers_of(self.problem)[1]

    @cached_property
    def placement(self) -> Placement:
        """The same for calculations; workers by their place."""
        workers, _ = workers_of(self.problem)
        return Placement(
            self.problem, workers, [workers.numbers.index(home) for home in self.homes]
        )

    @property
    def imbalance(self) -> float:
        """The slowest worker's tick over that of a perfect division."""
        return self.placement.imbalance

    @property
    def moves(self) -> tuple[ShardMove, ...]:
        """Shards that have another worker than before; of a first plan none."""
        present = self.problem.present or self.homes
        return tuple(
            ShardMove(shard.world, shard.zone, before, after)
            for shard, before, after in zip(self.problem.shards, present, self.homes, strict=True)
            if before != after
        )

    def workers(self) -> tuple[WorkerLoad, ...]:
        """All workers that answer, by number."""
        placement = self.placement
        known = placement.workers
        return tuple(
            WorkerLoad(
                number,
                known.scores[n],
                len(placement.on(n)),
                placement.load_s(n),
                float(placement.ticks_s()[n]),
            )
            for n, number in enumerate(known.numbers)
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON and the manifest; what follows from the rest is in it, too."""
        problem = self.problem
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "shards": [
                {**shard._asdict(), "worker": home}
                for shard, home in zip(problem.shards, self.homes, strict=True)
            ],
            "neighbors": [list(row) for row in problem.neighbors],
            "snapshot": problem.snapshot.to_dict(),
            "rule": asdict(problem.rule),
            "present": None if problem.present is None else list(problem.present),
            "in_row": problem.in_row,
            "cost_source": problem.cost_source,
            "method": self.method,
            "workers": [worker._asdict() for worker in self.workers()],
            "rejections": [rejection._asdict() for rejection in self.rejections],
            "moves": [move._asdict() for move in self.moves],
            "imbalance": self.imbalance,
            "cut_pairs": self.placement.cut_pairs,
        }


def make_plan(problem: Problem) -> Plan:
    """Place shards; the same problem gives the same plan, on every machine.

    Raises:
        NoAdmissibleWorkerError: there are shards to be placed and all workers are excluded.
    """
    placement, method = assign(problem)
    numbers = placement.workers.numbers
    return Plan(problem, tuple(numbers[home] for home in placement.homes), method)


def replan(plan: Plan, snapshot: LoadSnapshot) -> Plan:
    """The plan that follows from another snapshot, or from the same one again."""
    return make_plan(replace(plan.problem, snapshot=snapshot))
