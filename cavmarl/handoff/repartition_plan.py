"""Extension, off by default: other zones, where measured cost has gathered in a few.

Only the proposal: the map is cut anew by recursive bisection (`partition.zone_layouts`), which then
shares out measured cost and not lanes. Whether a world is cut so, and how its vehicles get there,
is the caller's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.partition.zone_statistics import imbalance

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Proposal:
    """A partition by measured cost."""

    partition: ZonePartition  # as many zones as before
    before: float  # maximum over mean of the zones' costs as they are
    after: float  # the same as they would be
    moved: int  # vehicles that would be in a zone of another number


def vehicle_costs(
    zones: NDArray[np.int32],  # of each vehicle
    # measured, of each zone; what a zone without vehicles costs is left out
    costs_s: Sequence[float],
) -> Floats:
    """Each zone's cost shared out among its vehicles, (n,)."""
    counts = np.bincount(zones, minlength=len(costs_s))
    shares: Floats = (np.asarray(costs_s) / np.maximum(counts, 1))[zones]
    return shares


def propose_zones(
    network: RoadNetwork,
    partition: ZonePartition,  # its zones now
    positions: Floats,  # (n, 2) x and y of vehicles in m
    costs_s: Sequence[float],  # measured, of each zone, seconds a tick
    *,
    tolerance: float = 0.1,  # by which share of the mean the costliest zone has to become cheaper
) -> Proposal | None:
    """Zones of about the same cost; None where they would gain no more than the tolerance."""
    if len(costs_s) != partition.count or not all(
        math.isfinite(cost_s) and cost_s >= 0.0 for cost_s in costs_s
    ):
        raise ConfigError(
            f"costs {list(costs_s)}: must be one a zone of {partition.count}, seconds from 0 up"
        )
    if partition.count == 1 or not len(positions):
        return None
    zones = partition.zones_of(positions)
    weights = vehicle_costs(zones, costs_s)
    density = np.column_stack([positions, weights])
    try:
        proposed = cut_map(network, "bisection", partition.count, density=density)
    except ConfigError:
        return None  # all stand in one place: no cut divides them
    proposed = _renumbered(proposed, zones, proposed.zones_of(positions))
    proposed_zones = proposed.zones_of(positions)
    before, after = (
        imbalance(np.bincount(owners, weights, partition.count).tolist())
        for owners in (zones, proposed_zones)
    )
    if before - after <= tolerance:
        return None
    return Proposal(proposed, before, after, int((zones != proposed_zones).sum()))


def _renumbered(
    partition: ZonePartition, before: NDArray[np.int32], after: NDArray[np.int32]
) -> ZonePartition:
    """The same zones, numbered so that many vehicles stay in the zone that they were in."""
    count = partition.count
    common = np.bincount(before * count + after, minlength=count * count).reshape(count, count)
    order = np.empty(count, dtype=np.int64)
    for _ in range(count):
        old, new = np.unravel_index(int(common.argmax()), common.shape)
        order[old] = new
        common[old, :] = common[:, new] = -1
    return ZonePartition(partition.bounds, partition.rects[order])
