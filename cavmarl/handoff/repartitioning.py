"""`Repartitioner`: new zones for running worlds whose vehicles are unevenly distributed.

Repartitioning is off by default. The zones change between two ticks. In the next tick, each vehicle
outside of its owner's new zone is handed over, as at any border. So the results do not change.
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
    """A change of the zones."""

    step: int  # number of steps that the worlds had made before
    before: float  # imbalance of the zones' vehicles, maximum / mean
    after: float  # imbalance in the new zones
    moved: int  # number of vehicles whose zone now has a different number
    ms: float  # duration in ms, without the transfers of vehicles in the next tick


def propose_cut(
    network: RoadNetwork,
    division: ZonedShards,  # has the vehicles of all zones
    partition: ZonePartition,  # the current zones
    tolerance: float,  # required decrease of the imbalance
) -> Proposal | None:
    """Return zones with a better balance of vehicles; None if the gain is within the tolerance."""
    rows = [division.vehicles(w) for w in range(division.num_worlds)]
    places = np.concatenate([np.column_stack([own["x"], own["y"]]) for own in rows])
    owners = np.concatenate([own["owner"] for own in rows])
    counts = np.bincount(owners, minlength=partition.count)
    return propose_zones(network, partition, places, counts.tolist(), tolerance=tolerance)


def is_due(step: int, every: int) -> bool:
    """Return whether zones are checked before a step (counted from 1); `every` 0: never."""
    return every > 0 and step > 1 and (step - 1) % every == 0


class Repartitioner:
    """A periodic search for zones with a better balance of vehicles."""

    def __init__(
        self,
        network: RoadNetwork,
        division: ZonedShards,
        coordination: WorldCoordinators,
        every: int,  # steps between checks
        tolerance: float,  # required decrease of the imbalance
    ) -> None:
        self.repartitions: list[Repartition] = []  # all changes so far
        self.steps = 0  # number of steps begun
        self._network = network
        self._division = division
        self._coordination = coordination
        self._every = every
        self._tolerance = tolerance

    def before_step(self, partition: ZonePartition) -> ZonePartition | None:
        """Count a step that begins. Return new zones if the zones change before this step.

        After a change, vehicles may be far from their owners' zones until the next tick hands them
        over. No caller may read vehicles before that.
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
