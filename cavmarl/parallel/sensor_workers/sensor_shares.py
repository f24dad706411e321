"""Which sensor worker senses what: in turn, or by what it costs.

What is shared out is a sensor of some agents. Agents of one sensor cost about the same, so where
there are many of them they are shared out by the dozen. By cost, frames are divided as well where
whole ones leave a worker with too much: each worker writes some lines of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.assignment import workers_of
from cavmarl.balance.initial_placement import spread
from cavmarl.balance.load_snapshot import idle_snapshot
from cavmarl.balance.local_search import refine
from cavmarl.balance.problem import Problem, ShardCost
from cavmarl.balance.shard_placement import Placement
from cavmarl.parallel.sensor_workers.line_costs import LineCosts

PIECES_A_WORKER = 4  # of the agents of one sensor, where there are so many
LEAST_S = 2e-4  # that has to be saved to divide frames: what stands around is looked up twice then


class Unit(NamedTuple):
    """One sensor of some agents; those of all worlds are counted one after the other."""

    sensor: int  # its number in the rig
    first: int  # agent
    last: int  # the one after the last
    begin: int = 0  # line of their frames
    end: int = 1  # the one after the last


@dataclass(frozen=True)
class Shares:
    """Which worker senses what."""

    units: tuple[Unit, ...]  # what is shared out
    homes: tuple[int, ...]  # the worker of each
    costs_s: tuple[float, ...]  # what each costs; equal where nothing has been measured
    workers: int  # how many there are

    @property
    def loads_s(self) -> list[float]:
        loads: list[list[float]] = [[] for _ in range(self.workers)]
        for home, cost_s in zip(self.homes, self.costs_s, strict=True):
            loads[home].append(cost_s)
        return [math.fsum(costs) for costs in loads]

    @property
    def divided(self) -> dict[int, list[tuple[int, tuple[int, int]]]]:
        """Worker and lines of each part of the sensors that are divided alike for all agents.

        Of others it cannot be told what a worker has spent on which lines.
        """
        parts: dict[int, list[tuple[int, tuple[int, int]]]] = {}
        agents: dict[int, set[tuple[int, int]]] = {}
        for unit, home in sorted(zip(self.units, self.homes, strict=True)):
            parts.setdefault(unit.sensor, []).append((home, (unit.begin, unit.end)))
            agents.setdefault(unit.sensor, set()).add((unit.first, unit.last))
        return {
            sensor: own
            for sensor, own in parts.items()
            if len(own) > 1 and len(agents[sensor]) == 1
        }

    def write(self, lines: NDArray[np.int32]) -> None:
        """Write which lines each worker writes, (n, S, agents, 2), of the sensors shared out."""
        for unit in self.units:
            lines[:, unit.sensor, unit.first : unit.last] = 0
        for unit, home in zip(self.units, self.homes, strict=True):
            lines[home, unit.sensor, unit.first : unit.last] = unit.begin, unit.end


def cut(sensors: Mapping[int, int], agents: int, workers: int) -> list[Unit]:
    """What is to be shared out of all agents, of sensors with so many lines a frame."""
    pieces = min(agents, PIECES_A_WORKER * workers)
    bounds = [agents * piece // pieces for piece in range(pieces + 1)]
    return [
        Unit(sensor, first, last, 0, lines)
        for sensor, lines in sensors.items()
        for first, last in pairwise(bounds)
    ]


def share_in_turn(units: Sequence[Unit], costs_s: Sequence[float], workers: int) -> Shares:
    """One after the other to the workers in turn, whatever they cost."""
    homes = tuple(number % workers for number in range(len(units)))
    return Shares(tuple(units), homes, tuple(costs_s), workers)


def share_by_cost(units: Sequence[Unit], costs_s: Sequence[float], workers: int) -> Shares:
    """The costliest first to the worker through first, then moves and swaps that help."""
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


def divide(shares: Shares, costs: LineCosts) -> Shares:
    """Move lines from workers with too many to workers with too few, until all have about the same.

    Each step leaves one worker with the mean, so no more frames are divided than there are workers.
    """
    units, homes, costs_s = list(shares.units), list(shares.homes), list(shares.costs_s)
    for _ in range(shares.workers - 1):
        loads_s = Shares(tuple(units), tuple(homes), tuple(costs_s), shares.workers).loads_s
        mean_s = math.fsum(loads_s) / shares.workers
        giver = max(range(shares.workers), key=loads_s.__getitem__)
        taker = min(range(shares.workers), key=loads_s.__getitem__)
        wanted_s = min(loads_s[giver] - mean_s, mean_s - loads_s[taker])
        if wanted_s < LEAST_S:
            break
        owned = [number for number, home in enumerate(homes) if home == giver]
        number = max(owned, key=costs_s.__getitem__)
        unit, cost_s = units[number], costs_s[number]
        if cost_s <= wanted_s:
            break  # nothing so large is left that a part of it would do
        if any(
            home == taker and other[:3] == unit[:3]
            for other, home in zip(units, homes, strict=True)
        ):
            break  # what one worker writes of a frame is in one piece
        before = costs.part(unit.sensor, 0, unit.end)
        within = costs.part(unit.sensor, unit.begin, unit.end)
        line = costs.line_at(unit.sensor, before - within * wanted_s / cost_s)
        if not unit.begin < line < unit.end:
            break  # it cannot be divided, or not so finely
        given_s = cost_s * costs.part(unit.sensor, line, unit.end) / within
        units[number], costs_s[number] = unit._replace(end=line), cost_s - given_s
        units.append(unit._replace(begin=line))
        homes.append(taker)
        costs_s.append(given_s)
    return Shares(tuple(units), tuple(homes), tuple(costs_s), shares.workers)
