"""A model of what a tick over nodes costs and takes, and its parameters out of measured runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

HOPS = 3  # one after the other in a tick: the lease, the share of another node, the report


@dataclass(frozen=True)
class NodeSample:
    """One run: a city of some size over some nodes; 0 nodes: undivided, in one process."""

    vehicles: int  # in all
    nodes: int  # that host them
    latency_s: float  # that was added to each connection
    tick_s: float  # by the clock
    node_s: float  # time of the processor a tick, of the dearest node; undivided: of the process
    caller_s: float  # the same of the caller
    own: float  # vehicles of the dearest node
    ghosts: float  # that it sees
    memory_bytes: float  # resident, of the largest node

    def to_dict(self) -> dict[str, float]:
        return asdict(self)


@dataclass(frozen=True)
class NodeCosts:
    """The parameters."""

    tick_s: float  # of a node's processor in each tick, whatever it has
    vehicle_s: float  # for each vehicle that it owns
    ghost_s: float  # for each that it sees
    whole_s: float  # of an undivided tick, whatever there is
    whole_vehicle_s: float  # for each vehicle
    caller_s: float  # of the caller in each tick
    caller_node_s: float  # for each node
    wake_s: float  # from one process to another, without latency
    base_bytes: float  # of a node, whatever there is
    city_bytes: float  # for each vehicle that the city has room for: map and tables, at every node
    own_bytes: float  # for each vehicle that a node owns or sees
    ghost_factor: float  # ghosts over the square root of a node's vehicles, per border

    def ghosts(self, vehicles: float, nodes: int) -> float:
        """How many vehicles of others a node in the middle of the city sees."""
        return self.ghost_factor * borders(nodes) * math.sqrt(vehicles / max(nodes, 1))

    def tick(self, vehicles: float, nodes: int, latency_s: float, cores: int) -> float:
        """Seconds of a tick; nodes beyond `cores` take turns."""
        if nodes == 0:
            return self.whole_s + self.whole_vehicle_s * vehicles
        own = vehicles / nodes
        node_s = self.tick_s + self.vehicle_s * own + self.ghost_s * self.ghosts(vehicles, nodes)
        caller_s = self.caller_s + self.caller_node_s * nodes
        hops = HOPS if nodes > 1 else HOPS - 1
        return node_s * math.ceil(nodes / cores) + caller_s + hops * (self.wake_s + latency_s)

    def memory(self, vehicles: float, nodes: int) -> float:
        """Bytes of a node, or of the undivided world."""
        own = vehicles / max(nodes, 1) + (self.ghosts(vehicles, nodes) if nodes else 0.0)
        return self.base_bytes + self.city_bytes * vehicles + self.own_bytes * own


def borders(nodes: int) -> float:
    """Borders of a zone in a square of so many zones, on average; each as long as its side."""
    return 0.0 if nodes < 2 else 4.0 - 4.0 / math.sqrt(nodes)


def fitted(samples: Sequence[NodeSample]) -> NodeCosts:
    """The parameters that fit runs best; of several sizes, over 0 and more nodes.

    Raises:
        ValueError: too few runs to tell them.
    """
    whole = [s for s in samples if s.nodes == 0]
    over = [s for s in samples if s.nodes > 0]
    calm = [s for s in over if s.latency_s == 0.0]
    if len({s.vehicles for s in whole}) < 2 or len({(s.vehicles, s.nodes) for s in calm}) < 3:
        raise ValueError("a fit needs two sizes undivided, and three runs over nodes")
    whole_s = _solve([[1.0, s.vehicles] for s in whole], [s.node_s for s in whole])
    node = _solve([[1.0, s.own, s.ghosts] for s in calm], [s.node_s for s in calm])
    caller = _solve([[1.0, s.nodes] for s in calm], [s.caller_s for s in calm])
    ghosts = [s.ghosts / (borders(s.nodes) * math.sqrt(s.own)) for s in calm if s.nodes > 1]
    memory = _solve(
        [[1.0, s.vehicles, s.own + s.ghosts] for s in (*whole, *calm)],
        [s.memory_bytes for s in (*whole, *calm)],
    )
    least = min(calm, key=lambda s: s.tick_s)
    hops = HOPS if least.nodes > 1 else HOPS - 1
    wake_s = max(0.0, (least.tick_s - least.node_s - least.caller_s) / hops)
    return NodeCosts(
        tick_s=node[0],
        vehicle_s=node[1],
        ghost_s=node[2],
        whole_s=whole_s[0],
        whole_vehicle_s=whole_s[1],
        caller_s=caller[0],
        caller_node_s=caller[1],
        wake_s=wake_s,
        base_bytes=memory[0],
        city_bytes=memory[1],
        own_bytes=memory[2],
        ghost_factor=float(np.mean(ghosts or [0.0])),
    )


def _solve(rows: Sequence[Sequence[float]], values: Sequence[float]) -> list[float]:
    """Non-negative least squares of relative deviations."""
    weights = 1.0 / np.maximum(np.array(values), 1e-12)
    matrix = np.array(rows) * weights[:, None]
    chosen = list(range(matrix.shape[1]))
    while True:  # what would be negative is none
        found = np.zeros(matrix.shape[1])
        found[chosen] = np.linalg.lstsq(matrix[:, chosen], np.ones(len(values)), rcond=None)[0]
        below = [n for n in chosen if found[n] < 0.0]
        if not below:
            return [float(value) for value in found]
        chosen.remove(min(below, key=lambda n: found[n]))
