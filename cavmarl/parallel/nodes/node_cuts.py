"""Repartitioning of zones that nodes host: the messages between the caller and the nodes.

The first node temporarily receives the rows of all vehicles, and proposes new zones. Then all nodes
repartition: each vehicle goes to the node of its zone, and ownership starts again, as when worlds
are loaded. The zones are a part of the kept state: if nodes are lost, the zones are restored too.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cavmarl.core.errors import MessageError
from cavmarl.engine.simulation import Simulation
from cavmarl.handoff.repartitioning import propose_cut
from cavmarl.handoff.shard_setup import neighbours_of
from cavmarl.ownership.decisions import Neighbours
from cavmarl.parallel.nodes.node_actions import ZoneRects
from cavmarl.parallel.nodes.node_peers import NodePeers
from cavmarl.parallel.nodes.peer_faults import check_indices
from cavmarl.zones.partition.zone_partition import ZonePartition


class ZoneCut(NamedTuple):
    """The zones of all worlds, as the caller has them."""

    partition: ZoneRects
    neighbours: Neighbours


class PoolState(NamedTuple):
    """A state that nodes have kept, as the caller describes it."""

    number: int
    zones: list[list[int]]  # zones of each node
    switched: int  # number of changes of owner when the state was kept
    cut: ZoneCut


def zones_as_json(partition: ZonePartition) -> ZoneRects:
    """Return zones as a JSON value: the bounds, and the rectangle of each zone."""
    return [list(map(float, partition.bounds)), *partition.rects.tolist()]


def read_zones(content: Sequence[Sequence[float]]) -> ZonePartition:
    """Read zones from a JSON value."""
    bounds, *rects = content
    min_x, min_y, max_x, max_y = bounds
    return ZonePartition((min_x, min_y, max_x, max_y), np.array(rects))


def neighbours_as_json(simulation: Simulation) -> list[Any]:
    """Return the pairs of zones between which vehicles can change, as a JSON value."""
    near, may_teleport = neighbours_of(simulation.division)
    return [list(map(sorted, near)), may_teleport]


def read_neighbours(content: Sequence[Any], zones: int) -> Neighbours:
    """Read the neighbours of each zone. Raises MessageError: the number of zones differs."""
    near, may_teleport = content
    if len(near) != zones:
        raise MessageError(f"it has neighbours of {len(near)} zones: there are {zones}")
    for some in near:
        check_indices("zone", some, zones)
    return Neighbours(tuple(map(frozenset, near)), bool(may_teleport))


def proposal_of(simulation: Simulation) -> list[Any] | None:
    """Propose zones, with the figures of `Repartition`; needs all vehicles in this process."""
    began = time.perf_counter()
    tolerance = simulation.config.zones.repartition_tolerance
    found = propose_cut(simulation.network, simulation.division, simulation.partition, tolerance)
    if found is None:
        return None
    figures = (found.before, found.after, found.moved, 1e3 * (time.perf_counter() - began))
    return [zones_as_json(found.partition), *figures]


def cut_worlds(
    simulation: Simulation, peers: NodePeers, content: Sequence[Sequence[float]]
) -> None:
    """Repartition the zones; all nodes have to call it."""
    division = simulation.division
    with peers.whole(simulation):
        vehicles = [division.vehicles(w).copy() for w in range(division.num_worlds)]
        contacts = division.contacts()
    simulation.zones.repartition(read_zones(content), vehicles, contacts)
