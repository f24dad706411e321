"""Which sensor worker senses what: in turn, or by what it costs.

What is shared out is a sensor of some agents. Agents of one sensor cost about the same, so where
there are many of them they are shared out by the dozen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.assignment import workers_of
from cavmarl.balance.placement import Placement
from cavmarl.balance.problem import Problem, ShardCost
from cavmarl.balance.refining import refine
from cavmarl.balance.snapshot import idle_snapshot
from cavmarl.balance.spreading import spread

__all__ = ["Shares", "Unit", "cut", "share_by_cost", "share_in_turn"]

PIECES_A_WORKER = 4  # of the agents of one sensor, where there are so many


class Unit(NamedTuple):
    """One sensor of some agents; those of all worlds are counted one after the other.

    Attributes:
        sensor: its number in the rig.
        first: agent.
        last: the one after the last.
    """

    sensor: int
    first: int
    last: int


@dataclass(frozen=True)
class Shares:
    """Who senses what.

    Attributes:
        units: what is shared out.
        homes: the worker of each.
        costs_s: what each costs; equal where nothing has been measured.
        workers: how many there are.
    """

    units: tuple[Unit, ...]
    homes: tuple[int, ...]
    costs_s: tuple[float, ...]
    workers: int

    @property
    def loads_s(self) -> list[float]:
        """What the units of each worker cost together."""
        loads: list[list[float]] = [[] for _ in range(self.workers)]
        for home, cost_s in zip(self.homes, self.costs_s, strict=True):
            loads[home].append(cost_s)
        return [math.fsum(costs) for costs in loads]

    def write(self, share: NDArray[np.int16]) -> None:
        """Write the worker of each agent of the sensors that are shared out, (S, agents)."""
        for unit, home in zip(self.units, self.homes, strict=True):
            share[unit.sensor, unit.first : unit.last] = home


def cut(sensors: Sequence[int], agents: int, workers: int) -> list[Unit]:
    """What is to be shared out of some sensors of all agents."""
    pieces = min(agents, PIECES_A_WORKER * workers)
    bounds = [agents * piece // pieces for piece in range(pieces + 1)]
    return [Unit(sensor, first, last) for sensor in sensors for first, last in pairwise(bounds)]


def share_in_turn(units: Sequence[Unit], costs_s: Sequence[float], workers: int) -> Shares:
    """One after the other to the workers in turn, whatever they cost."""
    homes = tuple(number % workers for number in range(len(units)))
    return Shares(tuple(units), homes, tuple(costs_s), workers)


def share_by_cost(units: Sequence[Unit], costs_s: Sequence[float], workers: int) -> Shares:
    """The costliest first to whoever would be through first, then moves and swaps that help.

    Args:
        units: by rising sensor and agent.
        costs_s: of each.
        workers: how many.
    """
    shards = tuple(
        ShardCost(unit.sensor, number, cost_s)
        for number, (unit, cost_s) in enumerate(zip(units, costs_s, strict=True))
    )
    alone: tuple[tuple[int, ...], ...] = ((),) * len(units)
    problem = Problem(shards, alone, idle_snapshot(min(workers, len(units))))
    hosts, _ = workers_of(problem)
    nowhere = Placement(problem, hosts, [-1] * len(units))
    placed = refine(spread(nowhere, [[number] for number in range(len(units))]))
    return Shares(tuple(units), tuple(placed.homes), tuple(costs_s), workers)
