"""`ZoneView`: a view of the owned vehicles, ghosts and transfers of one divided world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.shards.shard import Shard
from cavmarl.zones.partition.zone_partition import ZonePartition


class TransferInFlight(NamedTuple):
    """An incomplete transfer of a vehicle from one zone to another."""

    vehicle: int
    source: int  # the zone that owns the vehicle
    target: int  # the zone to which the vehicle is offered or switched
    state: str  # state in the protocol, for display


@dataclass(frozen=True)
class ZoneView:
    """One world's zones between two ticks."""

    partition: ZonePartition
    halo_m: float  # how far each zone sees beyond its borders
    # (n,) the owner of each vehicle, in the order of `Simulation.vehicles`
    owners: NDArray[np.int64]
    ghosts: tuple[NDArray[np.int64], ...]  # ids of the ghosts of each zone
    transfers: tuple[TransferInFlight, ...] = ()


def view_zones(
    shards: Sequence[Shard],  # one per zone, in the order of zones
    partition: ZonePartition,
    halo_m: float,  # how far each zone sees beyond its borders
    world: int = 0,
    transfers: Sequence[TransferInFlight] = (),  # transfers in that world
) -> ZoneView:
    """Return a view of the shards' vehicles in one world."""
    held = [shard.worlds for shard in shards]
    owned = [int(worlds.num_owned[world]) for worlds in held]
    ghosts = tuple(
        worlds.rows[world, num : worlds.num_rows[world]]["id"].copy()
        for worlds, num in zip(held, owned, strict=True)
    )
    owners = np.repeat(np.arange(len(owned)), owned)
    return ZoneView(partition, halo_m, owners, ghosts, tuple(transfers))
