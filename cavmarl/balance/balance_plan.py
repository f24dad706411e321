"""`Plan`: an assignment of shards to workers, with its inputs."""

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
    """A shard that moves to another worker."""

    world: int
    zone: int
    source: int  # worker before the move
    target: int  # worker after the move


class WorkerLoad(NamedTuple):
    """The load of an answering worker under a plan."""

    worker: int
    score: float  # LoadScore before the plan
    shards: int  # number of hosted shards
    load_s: float  # cost of its shards, s per tick
    tick_s: float  # duration of its tick, including the slowdown by other programs


@dataclass(frozen=True)
class Plan:
    """A reproducible placement: `make_plan(plan.problem) == plan`."""

    problem: Problem  # the input of the plan
    homes: tuple[int, ...]  # worker of each shard, in the order of `problem.shards`
    method: str  # how the placement was found

    def __post_init__(self) -> None:
        answering = {one.worker for one in self.problem.snapshot.workers if one.available}
        if len(self.homes) != len(self.problem.shards) or not answering.issuperset(self.homes):
            raise ConfigError(
                f"homes {self.homes}: there must be one for each of {len(self.problem.shards)} "
                f"shards, among the workers that answer, {sorted(answering)}"
            )

    @cached_property
    def rejections(self) -> tuple[Rejection, ...]:
        return workers_of(self.problem)[1]

    @cached_property
    def placement(self) -> Placement:
        """The placement for calculations; workers are given by their index."""
        workers, _ = workers_of(self.problem)
        return Placement(
            self.problem, workers, [workers.numbers.index(home) for home in self.homes]
        )

    @property
    def imbalance(self) -> float:
        """Duration of the slowest worker's tick / duration with a perfect division."""
        return self.placement.imbalance

    @property
    def moves(self) -> tuple[ShardMove, ...]:
        """Shards that change their worker; empty for a first plan."""
        present = self.problem.present or self.homes
        return tuple(
            ShardMove(shard.world, shard.zone, before, after)
            for shard, before, after in zip(self.problem.shards, present, self.homes, strict=True)
            if before != after
        )

    def workers(self) -> tuple[WorkerLoad, ...]:
        """Return the loads of all workers that answer, by number."""
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
        """Return plain values for JSON and the manifest, including derived values."""
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
    """Place the shards; equal problems give equal plans on every machine.

    Raises:
        NoAdmissibleWorkerError: shards need a place, and all workers are excluded; with
            `problem.in_row`, also if any worker is excluded.
    """
    placement, method = assign(problem)
    numbers = placement.workers.numbers
    return Plan(problem, tuple(numbers[home] for home in placement.homes), method)


def replan(plan: Plan, snapshot: LoadSnapshot) -> Plan:
    """Return the plan of the same problem with another snapshot."""
    return make_plan(replace(plan.problem, snapshot=snapshot))
