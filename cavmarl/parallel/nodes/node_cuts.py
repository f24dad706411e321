"""Zones that are cut anew while nodes host them: what goes between the caller and the nodes.

The first node sees the places of all vehicles for a moment and proposes other zones. Then all nodes
cut: each vehicle goes to the node of the zone that it is in, and ownership begins anew, as when
worlds are loaded. Which zones there are is part of what the caller goes back to when nodes are
lost.
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
    """The zones of all worlds, as the caller knows them."""

    partition: ZoneRects
    neighbours: Neighbours


class PoolState(NamedTuple):
    """What nodes have kept before a command, as the caller knows it."""

    number: int
    zones: list[list[int]]  # that each node hosted
    switched: int  # vehicles that had changed their owner
    cut: ZoneCut


def zones_as_json(partition: ZonePartition) -> ZoneRects:
    """Zones as JSON has them: the bounds, and the rectangle of each."""
    return [list(map(float, partition.bounds)), *partition.rects.tolist()]


def read_zones(told: Sequence[Sequence[float]]) -> ZonePartition:
    bounds, *rects = told
    min_x, min_y, max_x, max_y = bounds
    return ZonePartition((min_x, min_y, max_x, max_y), np.array(rects))


def neighbours_as_json(simulation: Simulation) -> list[Any]:
    """Between which zones vehicles change, likewise."""
    near, may_teleport = neighbours_of(simulation.division)
    return [list(map(sorted, near)), may_teleport]


def read_neighbours(told: Sequence[Any], zones: int) -> Neighbours:
    """The same, read. Raises MessageError: it tells of other zones than there are."""
    near, may_teleport = told
    if len(near) != zones:
        raise MessageError(f"it tells of {len(near)} zones: there are {zones}")
    for some in near:
        check_indices("zone", some, zones)
    return Neighbours(tuple(map(frozenset, near)), bool(may_teleport))


def proposal_of(simulation: Simulation) -> list[Any] | None:
    """Other zones, and what `Repartition` says of them; where all vehicles are in this process."""
    began = time.perf_counter()
    tolerance = simulation.config.zones.repartition_tolerance
    found = propose_cut(simulation.network, simulation.division, simulation.partition, tolerance)
    if found is None:
        return None
    said = (found.before, found.after, found.moved, 1e3 * (time.perf_counter() - began))
    return [zones_as_json(found.partition), *said]


def cut_worlds(simulation: Simulation, peers: NodePeers, told: Sequence[Sequence[float]]) -> None:
    """Divide the plane otherwise; all nodes have to call it."""
    division = simulation.division
    with peers.whole(simulation):
        vehicles = [division.vehicles(w).copy() for w in range(division.num_worlds)]
        contacts = division.contacts()
    simulation.zones.repartition(read_zones(told), vehicles, contacts)
