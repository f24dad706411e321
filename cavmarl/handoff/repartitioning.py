"""`Repartitioner`: repartition running worlds whose vehicles have gathered in a few zones.

An extension, off by default: the paper's zones are fixed. Between two ticks the plane is divided
otherwise; in the next one each vehicle that is in another zone than its owner's is handed over as
at any border. So no result depends on it.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from cavmarl.handoff.coordinator.coordinators import WorldCoordinators
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.repartition_plan import Proposal, propose_zones
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_partition import ZonePartition


class Repartition(NamedTuple):
    """Worlds have been cut anew."""

    step: int  # after which one, of all that these worlds have made
    before: float  # maximum over mean of the zones' vehicles
    after: float  # the same in the new zones
    moved: int  # vehicles that are in a zone of another number
    ms: float  # that it took; handing them over is part of the next tick


def propose_cut(
    network: RoadNetwork,
    division: ZonedShards,  # with the vehicles of all zones
    partition: ZonePartition,  # its zones now
    tolerance: float,  # by which share of the mean the fullest zone has to become emptier
) -> Proposal | None:
    """Zones that share out the vehicles of all worlds better; None: they would gain too little."""
    rows = [division.vehicles(w) for w in range(division.num_worlds)]
    places = np.concatenate([np.column_stack([own["x"], own["y"]]) for own in rows])
    owners = np.concatenate([own["owner"] for own in rows])
    counts = np.bincount(owners, minlength=partition.count)
    return propose_zones(network, partition, places, counts.tolist(), tolerance=tolerance)


def is_due(step: int, every: int) -> bool:
    """Whether zones are looked at before a step (counted from 1); `every` 0: never."""
    return every > 0 and step > 1 and (step - 1) % every == 0


class Repartitioner:
    """Looks every so many steps whether other zones would share out the vehicles better."""

    def __init__(
        self,
        network: RoadNetwork,
        division: ZonedShards,
        coordination: WorldCoordinators,
        every: int,  # steps between checks
        tolerance: float,  # by which share of the mean the fullest zone has to become emptier
    ) -> None:
        self.repartitions: list[Repartition] = []  # what has been done
        self.steps = 0  # that have begun
        self._network = network
        self._division = division
        self._coordination = coordination
        self._every = every
        self._tolerance = tolerance

    def before_step(self, partition: ZonePartition) -> ZonePartition | None:
        """Note that a step begins; its zones, if they are others than before.

        Nothing may look at vehicles between the cut and the next tick, which hands them over: their
        owners may be far away from them.
        """
        self.steps += 1
        if not is_due(self.steps, self._every):
            return None
        began = time.perf_counter()
        proposal = propose_cut(self._network, self._division, partition, self._tolerance)
        if proposal is None:
            return None
        self.cut(proposal.partition)
        ms = 1e3 * (time.perf_counter() - began)
        self.repartitions.append(
            Repartition(self.steps - 1, proposal.before, proposal.after, proposal.moved, ms)
        )
        return proposal.partition

    def cut(self, partition: ZonePartition) -> None:
        self._division.cut(partition)
        self._coordination.cut()
