"""A model of the costs and times of ticks over nodes, with parameters fitted to measured runs."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np

from cavmarl.driving.vehicles import VEHICLE

CACHES = Path("/sys/devices/system/cpu/cpu0/cache")
CACHE_BYTES = {"index2": 1 << 20, "index3": 32 << 20}  # used if the system reports none
ROW_BYTES = 2 * VEHICLE.itemsize  # per vehicle: a tick reads one table and writes another


@dataclass(frozen=True)
class NodeSample:
    """One run of a city over nodes; 0 nodes: undivided, in one process."""

    vehicles: int  # number of vehicles in the city
    nodes: int  # number of nodes
    tick_s: float  # wall time
    node_s: float  # processor time per tick of the most expensive node, or of the undivided process
    caller_s: float  # processor time per tick of the caller
    own: float  # vehicles of the most expensive node
    ghosts: float  # ghosts of this node
    crossings: float  # vehicles that change their node, per step
    memory_bytes: float  # resident memory of the largest process
    latency_s: float  # latency added to each connection
    ticks_per_step: float

    def to_dict(self) -> dict[str, float]:
        return asdict(self)


class Caches(NamedTuple):
    """The sizes of the caches, in rows of vehicles, and the number of cores that share a cache."""

    own: float  # cache of a core
    shared: float  # cache of all cores
    cores: int

    def beyond(self, rows: float, busy: int) -> tuple[float, float]:
        """Return how many rows of a core exceed its own cache, and how many its shared part."""
        share = self.shared / max(min(busy, self.cores), 1)
        return max(rows - self.own, 0.0), max(rows - share, 0.0)


@dataclass(frozen=True)
class NodeCosts:
    """Parameters of the cost model."""

    tick_s: float  # processor time of a node per tick, constant part
    ghost_s: float  # processor time per ghost
    whole_s: float  # processor time of an undivided tick, constant part
    vehicle_s: float  # processor time per vehicle
    far_s: float  # additional time per row (vehicle or ghost) that exceeds a core's own cache
    memory_s: float  # additional time per row beyond all caches
    caches: Caches
    caller_s: float  # processor time of the caller per tick
    caller_node_s: float  # additional processor time of the caller per node and tick
    wake_s: float  # time from one process to another, without latency
    uneven: float  # additional time of the slowest node in a tick, as a share
    base_bytes: float  # memory of a node, constant part
    city_bytes: float  # memory of map and tables at a node, per vehicle of the city
    own_bytes: float  # additional memory per owned vehicle and ghost
    ghost_factor: float  # ghosts per border / square root of a node's vehicles
    crossing_share: float  # share of a node's ghosts that change their node in a step
    ticks_per_step: float

    def ghosts(self, vehicles: float, nodes: int) -> float:
        """Return the number of ghosts of a node in the middle of the city."""
        return self.ghost_factor * borders(nodes) * math.sqrt(vehicles / max(nodes, 1))

    def hops(self, vehicles: float, nodes: int) -> float:
        """Return the mean number of sequential messages of a tick.

        Each step has a command and a report. With several nodes, there are also messages in each
        tick and for the agents. If a vehicle crosses a border, an offer and its answer replace the
        report.
        """
        if nodes < 2:
            return 2.0 / self.ticks_per_step
        crossings = self.crossing_share * self.ghosts(vehicles, nodes) * nodes
        offers = 1.0 - math.exp(-crossings)
        return (self.ticks_per_step + 3.0 + offers) / self.ticks_per_step

    def work(self, vehicles: float, ghosts: float, busy: int) -> float:
        """Return the processor time per tick of stepping vehicles, without `ghost_s` of ghosts.

        Rows that fit a cache are read from the cache, the other rows from memory. `busy`: number of
        working cores.
        """
        far, farthest = self.caches.beyond(vehicles + ghosts, busy)
        return self.vehicle_s * vehicles + self.far_s * far + self.memory_s * farthest

    def tick(self, vehicles: float, nodes: int, latency_s: float, cores: int) -> float:
        """Return the time of a tick in s; nodes beyond `cores` share cores and their caches."""
        if nodes == 0:
            return self.whole_s + self.work(vehicles, 0.0, 1)
        turns = math.ceil(nodes / cores)
        own, ghosts = turns * vehicles / nodes, turns * self.ghosts(vehicles, nodes)
        node_s = turns * self.tick_s + self.ghost_s * ghosts
        node_s += self.work(own, ghosts, min(nodes, cores))
        node_s *= 1.0 + (self.uneven if nodes > 1 else 0.0)
        caller_s = self.caller_s + self.caller_node_s * nodes
        return node_s + caller_s + self.hops(vehicles, nodes) * (self.wake_s + latency_s)

    def memory(self, vehicles: float, nodes: int) -> float:
        """Return the memory of a node or of the undivided world, in bytes."""
        own = vehicles / max(nodes, 1) + (self.ghosts(vehicles, nodes) if nodes else 0.0)
        return self.base_bytes + self.city_bytes * vehicles + self.own_bytes * own


def borders(nodes: int) -> float:
    """Return the mean number of borders of a zone in a square of equal square zones."""
    return 0.0 if nodes < 2 else 4.0 - 4.0 / math.sqrt(nodes)


def caches_here() -> Caches:
    """Return the caches of this machine."""
    own, shared = (_cache_bytes(level) / ROW_BYTES for level in CACHE_BYTES)
    return Caches(own, shared, os.cpu_count() or 1)


def _cache_bytes(level: str) -> int:
    try:
        text = (CACHES / level / "size").read_text(encoding="ascii").strip()
        return int(text.removesuffix("K")) * 1024
    except (OSError, ValueError):
        return CACHE_BYTES[level]


def fitted(samples: Sequence[NodeSample], caches: Caches) -> NodeCosts:
    """Fit the parameters to runs of several sizes, with 0 and more nodes.

    Raises:
        ValueError: there are too few runs.
    """
    whole = [s for s in samples if s.nodes == 0]
    calm = [s for s in samples if s.nodes > 0 and s.latency_s == 0.0]
    divided = [s for s in calm if s.nodes > 1]
    if len({s.vehicles for s in whole}) < 2 or len({(s.vehicles, s.nodes) for s in calm}) < 3:
        raise ValueError("a fit needs undivided runs of two sizes and three runs over nodes")
    work = [
        [s.nodes == 0, s.nodes > 0, s.ghosts, s.own, *caches.beyond(s.own + s.ghosts, s.nodes)]
        for s in (*whole, *calm)
    ]
    spent = _solve(work, [s.node_s for s in (*whole, *calm)])
    whole_s, tick_s, ghost_s, vehicle_s, far_s, memory_s = spent
    caller = _solve([[1.0, s.nodes] for s in calm], [s.caller_s for s in calm])
    memory = _solve(
        [[1.0, s.vehicles, s.own + s.ghosts] for s in (*whole, *calm)],
        [s.memory_bytes for s in (*whole, *calm)],
    )
    costs = NodeCosts(
        tick_s=tick_s,
        ghost_s=ghost_s,
        whole_s=whole_s,
        vehicle_s=vehicle_s,
        far_s=far_s,
        memory_s=memory_s,
        caches=caches,
        caller_s=caller[0],
        caller_node_s=caller[1],
        wake_s=0.0,
        uneven=0.0,
        base_bytes=memory[0],
        city_bytes=memory[1],
        own_bytes=memory[2],
        ghost_factor=_mean([s.ghosts / (borders(s.nodes) * math.sqrt(s.own)) for s in divided]),
        crossing_share=_mean([s.crossings / (s.ghosts * s.nodes) for s in divided if s.ghosts]),
        ticks_per_step=samples[0].ticks_per_step,
    )
    # The rest of the wall time is waking processes and waiting for the slowest node.
    waits = [s.tick_s - s.node_s - s.caller_s for s in calm]
    hops = [costs.hops(s.vehicles, s.nodes) for s in calm]
    rows = [[n, s.node_s if s.nodes > 1 else 0.0] for n, s in zip(hops, calm, strict=True)]
    wake_s, uneven = _solve(rows, waits, [s.tick_s for s in calm])
    return replace(costs, wake_s=wake_s, uneven=uneven)


def _mean(values: Sequence[float]) -> float:
    return fmean(values or [0.0])


def _solve(
    rows: Sequence[Sequence[float]],
    values: Sequence[float],
    scales: Sequence[float] = (),  # deviations are relative to the scales, by default to the values
) -> list[float]:
    """Solve a non-negative least-squares problem with relative deviations."""
    weights = 1.0 / np.maximum(np.array(scales or values), 1e-12)
    matrix, wanted = np.array(rows, dtype=np.float64) * weights[:, None], values * weights
    chosen = list(range(matrix.shape[1]))
    while True:  # until no coefficient is negative
        found = np.zeros(matrix.shape[1])
        found[chosen] = np.linalg.lstsq(matrix[:, chosen], wanted, rcond=None)[0]
        below = [n for n in chosen if found[n] < 0.0]
        if not below:
            return [float(value) for value in found]
        chosen.remove(min(below, key=lambda n: found[n]))
