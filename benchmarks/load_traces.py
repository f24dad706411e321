"""Load traces: positions and costs of vehicles, and other load on workers.

A trace is generated or recorded; `balance_replay` replays both kinds through the same balancer. The
load by other programs is always generated, because a real load would affect the measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.cost_models import ShardContent
from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.evaluate.shard_costs import MeasuredRound
from cavmarl.handoff.repartition_plan import vehicle_costs
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.partition.zone_survey import lane_samples

__all__ = ["Crowd", "LoadRound", "LoadTrace", "generated_trace", "recorded_trace"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LoadRound:
    """The loads between two placements of shards."""

    ids: NDArray[np.int64]  # (n,) vehicles
    places: Floats  # (n, 2) positions, m
    agents: NDArray[np.bool_]  # (n,) whether an agent drives the vehicle
    vehicle_s: Floats  # (n,) cost of each vehicle, s per tick
    noise: Floats  # (k,) measured / true cost of each zone
    snapshot: LoadSnapshot  # load on workers by other programs


@dataclass(frozen=True)
class LoadTrace:
    """Rounds of one world on one map."""

    network: RoadNetwork  # the map
    partition: ZonePartition  # its initial zones
    ticks: int  # per round
    # additional cost of a vehicle that changed its zone in a round, s per tick
    migration_s: float
    rounds: tuple[LoadRound, ...]  # in temporal order

    def arrivals(self, number: int, partition: ZonePartition) -> NDArray[np.int64]:
        """Return the number of vehicles of each zone (k,) that have entered it in this round."""
        now = self.rounds[number]
        if number == 0:
            return np.zeros(partition.count, dtype=np.int64)
        before = self.rounds[number - 1]
        _, here, there = np.intersect1d(now.ids, before.ids, return_indices=True)
        zones = partition.zones_of(now.places[here])
        came = zones[zones != partition.zones_of(before.places[there])]
        return np.bincount(came, minlength=partition.count)

    def costs_s(self, number: int, partition: ZonePartition) -> Floats:
        """Return the true cost (k,) of each zone in a round, s per tick."""
        now = self.rounds[number]
        zones = partition.zones_of(now.places)
        own = np.bincount(zones, now.vehicle_s, partition.count)
        return np.asarray(own + self.migration_s * self.arrivals(number, partition))

    def measured_s(self, number: int, partition: ZonePartition) -> Floats:
        """Return the measured cost (k,) of each zone, s per tick."""
        return np.asarray(self.costs_s(number, partition) * self.rounds[number].noise)

    def contents(self, number: int, partition: ZonePartition) -> list[ShardContent]:
        """Return the content of each zone."""
        now = self.rounds[number]
        zones = partition.zones_of(now.places)
        counts = np.bincount(zones, minlength=partition.count)
        agents = np.bincount(zones[now.agents], minlength=partition.count)
        rows = zip(counts, agents, self.arrivals(number, partition), strict=True)
        return [ShardContent(*map(float, row)) for row in rows]


@dataclass(frozen=True)
class Crowd:
    """A crowd of vehicles around a hot spot that wanders over the map."""

    vehicles: int = 600  # number of vehicles
    agents: float = 0.2  # share driven by agents
    vehicle_s: float = 1e-6  # cost of each vehicle, s per tick
    agent_s: float = 4e-6  # additional cost of an agent's sensors, s per tick
    migration_s: float = 2e-5  # cost of a change of zone, once
    ticks: int = 200  # per round
    pull: float = 15.0  # density at the hot spot / density elsewhere
    width: float = 0.2  # width of the hot spot, as a share of the map's shorter side
    stride: float = 0.04  # movement of the hot spot per round, as a share of the shorter side
    turnover: float = 0.2  # share of vehicles that get a new position each round
    noise: float = 0.1  # standard deviation of the logarithm of measured costs


def generated_trace(
    network: RoadNetwork,
    partition: ZonePartition,
    *,
    rounds: int,
    workers: int,
    seed: int,
    crowd: Crowd | None = None,
) -> LoadTrace:
    """Generate a crowd that wanders over the map; the same seed gives the same trace."""
    crowd = crowd or Crowd()
    draw = np.random.default_rng(seed)
    samples = lane_samples(network)
    places, lengths = samples[:, :2], samples[:, 2]
    low, high = places.min(axis=0), places.max(axis=0)
    side_m = float(max((high - low).min(), 1.0))
    middle = draw.uniform(low, high)
    agents = draw.random(crowd.vehicles) < crowd.agents
    at = np.full(crowd.vehicles, -1)
    found = []
    for snapshot in _other_loads(draw, rounds, workers):
        middle = np.clip(middle + draw.normal(0.0, crowd.stride * side_m, 2), low, high)
        squares = ((places - middle) ** 2).sum(axis=1) / (crowd.width * side_m) ** 2
        chances = lengths * (1.0 + crowd.pull * np.exp(-0.5 * squares))
        new = (draw.random(crowd.vehicles) < crowd.turnover) | (at < 0)
        at[new] = draw.choice(len(places), int(new.sum()), p=chances / chances.sum())
        found.append(
            LoadRound(
                ids=np.arange(crowd.vehicles),
                places=places[at],
                agents=agents,
                vehicle_s=np.where(agents, crowd.vehicle_s + crowd.agent_s, crowd.vehicle_s),
                noise=draw.lognormal(0.0, crowd.noise, partition.count),
                snapshot=snapshot,
            )
        )
    return LoadTrace(network, partition, crowd.ticks, crowd.migration_s / crowd.ticks, tuple(found))


def recorded_trace(
    network: RoadNetwork,
    partition: ZonePartition,
    measured: Sequence[MeasuredRound],
    *,
    ticks: int,
    workers: int,
    seed: int,
) -> LoadTrace:
    """Build a trace from measured costs of zones; each vehicle has the mean cost in its zone."""
    others = _other_loads(np.random.default_rng(seed), len(measured), workers)
    return LoadTrace(
        network,
        partition,
        ticks,
        0.0,  # the costs of vehicles include migrations
        tuple(
            LoadRound(
                ids=one.ids,
                places=one.places,
                agents=one.agents,
                vehicle_s=vehicle_costs(partition.zones_of(one.places), one.costs_s.tolist()),
                noise=np.ones(partition.count),
                snapshot=snapshot,
            )
            for one, snapshot in zip(measured, others, strict=True)
        ),
    )


# Other load by resource: mean, standard deviation, maximum.
_OTHERS = {"cpu": (0.3, 0.15, 0.95), "ram": (0.5, 0.1, 0.85), "gpu": (0.4, 0.15, 0.9)}
_STAYS = 0.9  # autocorrelation of the deviation from round to round


def _other_loads(draw: np.random.Generator, rounds: int, workers: int) -> list[LoadSnapshot]:
    """Draw slowly varying utilisations, which sometimes exceed the thresholds of workers."""
    means, spreads, most = np.array(list(_OTHERS.values())).T
    stray = draw.normal(0.0, spreads, (workers, len(means)))
    found = []
    for _ in range(rounds):
        push = draw.normal(0.0, spreads, stray.shape)
        stray = _STAYS * stray + np.sqrt(1.0 - _STAYS**2) * push
        shares = np.clip(means + stray, 0.0, most)
        uses = [Utilisation(*row) for row in shares.tolist()]
        candidates = tuple(Candidate(worker, use) for worker, use in enumerate(uses))
        found.append(LoadSnapshot(candidates, "simulated", "generated"))
    return found
