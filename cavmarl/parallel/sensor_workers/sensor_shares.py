"""Distribution of sensing over sensor workers: round robin, or by cost.

A unit is one sensor of some agents. For one sensor, all agents cost about the same, so a unit has
many agents. Distribution by cost also divides frames if whole frames would overload a worker: then
several workers write lines of the same frames.
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
from cavmarl.balance.initial_placement import assign_longest_first
from cavmarl.balance.load_snapshot import idle_snapshot
from cavmarl.balance.local_search import refine
from cavmarl.balance.problem import Problem, ShardCost
from cavmarl.balance.shard_placement import Placement
from cavmarl.parallel.sensor_workers.line_costs import LineCosts

PIECES_PER_WORKER = 4  # number of units of one sensor per worker, if there are enough agents
# A frame is divided only if this saves at least this time, since both workers then look up the same
# surroundings.
MIN_GAIN_S = 2e-4


class Unit(NamedTuple):
    """One sensor of some agents, which are numbered through all worlds."""

    sensor: int  # number in the rig
    first: int  # first agent
    last: int  # number after the last agent
    begin: int = 0  # first line of the agents' frames
    end: int = 1  # number after the last line


@dataclass(frozen=True)
class Shares:
    """The units, and the worker of each."""

    units: tuple[Unit, ...]
    homes: tuple[int, ...]  # worker of each unit
    costs_s: tuple[float, ...]  # cost of each unit; equal if nothing was measured
    workers: int  # number of workers

    @property
    def loads_s(self) -> list[float]:
        """Total cost of each worker."""
        loads: list[list[float]] = [[] for _ in range(self.workers)]
        for home, cost_s in zip(self.homes, self.costs_s, strict=True):
            loads[home].append(cost_s)
        return [math.fsum(costs) for costs in loads]

    @property
    def divided(self) -> dict[int, list[tuple[int, tuple[int, int]]]]:
        """Worker and lines of each part, for sensors divided in the same way for all agents.

        Other sensors are left out: measured times of whole frames, or of different divisions,
        cannot be attributed to lines.
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
        """Write the lines of each worker, (n, S, agents, 2), for the sensors of the units."""
        for unit in self.units:
            lines[:, unit.sensor, unit.first : unit.last] = 0
        for unit, home in zip(self.units, self.homes, strict=True):
            lines[home, unit.sensor, unit.first : unit.last] = unit.begin, unit.end


def cut(sensors: Mapping[int, int], agents: int, workers: int) -> list[Unit]:
    """Return the units of all agents; `sensors` has the lines per frame of each sensor."""
    pieces = min(agents, PIECES_PER_WORKER * workers)
    bounds = [agents * piece // pieces for piece in range(pieces + 1)]
    return [
        Unit(sensor, first, last, 0, lines)
        for sensor, lines in sensors.items()
        for first, last in pairwise(bounds)
    ]


def share_in_turn(units: Sequence[Unit], costs_s: Sequence[float], workers: int) -> Shares:
    """Assign the units to the workers in turn, regardless of their costs."""
    homes = tuple(number % workers for number in range(len(units)))
    return Shares(tuple(units), homes, tuple(costs_s), workers)


def share_by_cost(units: Sequence[Unit], costs_s: Sequence[float], workers: int) -> Shares:
    """Assign the most expensive units first, then improve by moves and swaps."""
    shards = tuple(
        ShardCost(unit.sensor, number, cost_s)
        for number, (unit, cost_s) in enumerate(zip(units, costs_s, strict=True))
    )
    alone: tuple[tuple[int, ...], ...] = ((),) * len(units)
    problem = Problem(shards, alone, idle_snapshot(min(workers, len(units))))
    hosts, _ = workers_of(problem)
    nowhere = Placement(problem, hosts, [-1] * len(units))
    placed = refine(assign_longest_first(nowhere, [[number] for number in range(len(units))]))
    return Shares(tuple(units), tuple(placed.homes), tuple(costs_s), workers)


def divide(shares: Shares, costs: LineCosts) -> Shares:
    """Move lines from the busiest to the least busy worker, until loads are about equal.

    Each move brings one worker to the mean, so there are fewer moves than workers.
    """
    units, homes, costs_s = list(shares.units), list(shares.homes), list(shares.costs_s)
    for _ in range(shares.workers - 1):
        loads_s = Shares(tuple(units), tuple(homes), tuple(costs_s), shares.workers).loads_s
        mean_s = math.fsum(loads_s) / shares.workers
        giver = max(range(shares.workers), key=loads_s.__getitem__)
        taker = min(range(shares.workers), key=loads_s.__getitem__)
        wanted_s = min(loads_s[giver] - mean_s, mean_s - loads_s[taker])
        if wanted_s < MIN_GAIN_S:
            break
        owned = [number for number, home in enumerate(homes) if home == giver]
        number = max(owned, key=costs_s.__getitem__)
        unit, cost_s = units[number], costs_s[number]
        if cost_s <= wanted_s:
            break  # the worker has no unit that is large enough to divide
        if any(
            home == taker and other[:3] == unit[:3]
            for other, home in zip(units, homes, strict=True)
        ):
            break  # the taker already writes a range of these frames, and can write only one range
        before = costs.part(unit.sensor, 0, unit.end)
        within = costs.part(unit.sensor, unit.begin, unit.end)
        line = costs.line_at(unit.sensor, before - within * wanted_s / cost_s)
        if not unit.begin < line < unit.end:
            break  # one of the workers would have no line
        given_s = cost_s * costs.part(unit.sensor, line, unit.end) / within
        units[number], costs_s[number] = unit._replace(end=line), cost_s - given_s
        units.append(unit._replace(begin=line))
        homes.append(taker)
        costs_s.append(given_s)
    return Shares(tuple(units), tuple(homes), tuple(costs_s), shares.workers)
