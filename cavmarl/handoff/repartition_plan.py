"""Proposal of new zones with an even distribution of measured cost; off by default.

The proposal cuts the map by recursive bisection (`partition.zone_layouts`), weighted by measured
cost instead of lanes. The caller decides whether to use it, and moves the vehicles.
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
    """A proposed partition by measured cost."""

    partition: ZonePartition  # with as many zones as before
    before: float  # current imbalance of the zones' costs, maximum / mean
    after: float  # imbalance with the proposed zones
    moved: int  # number of vehicles whose zone would have a different number


def vehicle_costs(
    zones: NDArray[np.int32],  # (n,) zone of each vehicle
    costs_s: Sequence[float],  # measured cost of each zone; the cost of empty zones is ignored
) -> Floats:
    """Return the cost (n,) of each vehicle: an equal share of its zone's cost."""
    counts = np.bincount(zones, minlength=len(costs_s))
    shares: Floats = (np.asarray(costs_s) / np.maximum(counts, 1))[zones]
    return shares


def propose_zones(
    network: RoadNetwork,
    partition: ZonePartition,  # the current zones
    positions: Floats,  # (n, 2) x and y of vehicles in m
    costs_s: Sequence[float],  # measured cost of each zone in seconds per tick
    *,
    tolerance: float = 0.1,  # required decrease of the imbalance
) -> Proposal | None:
    """Return zones of about equal cost; None if the gain is within the tolerance."""
    if len(costs_s) != partition.count or not all(
        math.isfinite(cost_s) and cost_s >= 0.0 for cost_s in costs_s
    ):
        raise ConfigError(
            f"costs {list(costs_s)}: use one number of seconds for each of {partition.count} "
            "zones, at least 0"
        )
    if partition.count == 1 or not len(positions):
        return None
    zones = partition.zones_of(positions)
    weights = vehicle_costs(zones, costs_s)
    density = np.column_stack([positions, weights])
    try:
        proposed = cut_map(network, "bisection", partition.count, density=density)
    except ConfigError:
        return None  # no cut divides vehicles that are all in one place
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
    """Return the zones numbered so that many vehicles keep the number of their zone."""
    count = partition.count
    common = np.bincount(before * count + after, minlength=count * count).reshape(count, count)
    order = np.empty(count, dtype=np.int64)
    for _ in range(count):
        old, new = np.unravel_index(int(common.argmax()), common.shape)
        order[old] = new
        common[old, :] = common[:, new] = -1
    return ZonePartition(partition.bounds, partition.rects[order])
