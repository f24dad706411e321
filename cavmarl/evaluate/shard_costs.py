"""Measured costs of shards: the processor time of each zone per tick."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.problem import ShardCost
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.evaluate.built_in_runs import DrivenWorld

PARTS = 5


@dataclass(frozen=True)
class MeasuredRound:
    """Measured steps of one world."""

    costs_s: NDArray[np.float64]  # (k,) seconds per tick of each zone
    ids: NDArray[np.int64]  # (n,) vehicles after the last step
    places: NDArray[np.float64]  # (n, 2) places of the vehicles, m
    agents: NDArray[np.bool_]  # (n,) whether an agent drives the vehicle


@dataclass(frozen=True)
class MeasuredWorlds:
    """Measured worlds of one environment."""

    costs: tuple[ShardCost, ...]  # costs of their shards
    # (n, 2) places of all vehicles after the last step, m
    places: NDArray[np.float64]

    def zone_costs_s(self) -> list[float]:
        """Return the costs of the zones, all worlds together, in seconds per tick."""
        zones = [shard.zone for shard in self.costs]
        sums: list[float] = np.bincount(zones, [shard.cost_s for shard in self.costs]).tolist()
        return sums


def measure_rounds(
    simulation: Simulation,
    rounds: int,
    steps: int,
    *,
    before: int,
    stepped: Callable[[], None] = lambda: None,
) -> Iterator[MeasuredRound]:
    """Drive one world from its reset: `before` unmeasured steps, then `rounds` rounds of `steps`.

    `stepped` is called after each step.
    """
    for name, value in (("rounds", rounds), ("steps", steps), ("before", before)):
        if value < 1:
            raise ConfigError(f"{name} = {value}: must be at least 1")
    clock = simulation.zones.measure_costs()
    world = DrivenWorld(simulation)
    ticks = steps * simulation.config.clock.ticks_per_step
    for _ in range(before):
        world.step(world.commands())
        stepped()
    clock.take_s()
    for _ in range(rounds):
        for _ in range(steps):
            world.step(world.commands())
            stepped()
        rows = simulation.vehicles()
        yield MeasuredRound(
            costs_s=clock.take_s() / ticks,
            ids=rows["id"].astype(np.int64),
            places=np.stack([rows["x"], rows["y"]], axis=1),
            agents=rows["agent"] >= 0,
        )


def measure_shards(
    simulation: Simulation,
    worlds: int,
    seed: int,
    *,
    steps: int,
    before: int,
    told: Callable[[int, int], None] = lambda done, total: None,
) -> MeasuredWorlds:
    """Return the costs of all zones of the first `worlds` worlds of a seed.

    Each world takes `before` unmeasured steps, then `steps` measured ones. The cost of a zone is
    the median of `PARTS` parts of these, so one-time work such as loading a kernel does not count.
    `told` is called with the steps done and the total.
    """
    if steps < PARTS:
        raise ConfigError(f"steps = {steps}: must be at least {PARTS}")
    costs: list[ShardCost] = []
    places = []
    done = itertools.count(1)
    total = worlds * (before + steps // PARTS * PARTS)

    def stepped() -> None:
        told(next(done), total)

    for number in range(worlds):
        simulation.seed(seed, number)
        simulation.reset()
        rounds = measure_rounds(simulation, PARTS, steps // PARTS, before=before, stepped=stepped)
        parts = list(rounds)
        median_s = np.median([part.costs_s for part in parts], axis=0).tolist()
        costs += [ShardCost(number, zone, cost_s) for zone, cost_s in enumerate(median_s)]
        places.append(parts[-1].places)
    return MeasuredWorlds(tuple(costs), np.concatenate(places))
