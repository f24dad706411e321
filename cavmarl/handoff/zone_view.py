"""`ZoneView`: owned vehicles, ghosts and hand-overs of one divided world, to read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.shards.shard import Shard
from cavmarl.zones.partition.zone_partition import ZonePartition


class TransferInFlight(NamedTuple):
    """A vehicle that is on its way from one zone to another."""

    vehicle: int
    source: int  # the zone that owns it
    target: int  # the zone that it is offered or switched to
    state: str  # of the protocol, for people to read


@dataclass(frozen=True)
class ZoneView:
    """One world's zones between two ticks."""

    partition: ZonePartition  # where the zones are
    halo_m: float  # how far each sees over its borders
    # (n,) the zone that owns each vehicle, in the order of `Simulation.vehicles`
    owners: NDArray[np.int64]
    # of each zone, the ids of other zones' vehicles that it sees
    ghosts: tuple[NDArray[np.int64], ...]
    transfers: tuple[TransferInFlight, ...] = ()  # in flight


def view_zones(
    shards: Sequence[Shard],  # one a zone, in the order of zones
    partition: ZonePartition,  # where the zones are
    halo_m: float,  # how far each sees over its borders
    world: int = 0,
    transfers: Sequence[TransferInFlight] = (),  # in flight in that world
) -> ZoneView:
    """What the shards hold of one world."""
    held = [shard.worlds for shard in shards]
    owned = [int(worlds.num_owned[world]) for worlds in held]
    ghosts = tuple(
        worlds.rows[world, num : worlds.num_rows[world]]["id"].copy()
        for worlds, num in zip(held, owned, strict=True)
    )
    owners = np.repeat(np.arange(len(owned)), owned)
    return ZoneView(partition, halo_m, owners, ghosts, tuple(transfers))
