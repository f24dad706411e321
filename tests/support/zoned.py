"""Rows of several zones, for tests of kernels that move rows between zones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import ZoneState
from cavmarl.shards.shard import make_zone_state
from cavmarl.zones.kernels.borders import Borders
from cavmarl.zones.kernels.ghost_exchange import exchange
from cavmarl.zones.kernels.ownership_changes import BorderRecords, make_book
from cavmarl.zones.partition.zone_halo import zone_halo
from cavmarl.zones.partition.zone_partition import ZonePartition

SIDE = 1
NO_BORDERS = Borders(0.0, 0.0, 0.0)


def zoned_of(parts: Sequence[NDArray[np.void]], room: int = 0) -> ZoneState:
    """Return the state of a world whose zones own these rows; unused rows have invalid values.

    Args:
        parts: the rows of each zone.
        room: capacity of a zone; by default, enough for all vehicles.
    """
    zoned = make_zone_state(len(parts), 1, room or max(1, sum(map(len, parts))))
    zoned.rows["id"] = zoned.border[:] = -7
    for numbers in (zoned.num_rows, zoned.num_near, zoned.num_border):
        numbers[:] = -7
    for zone, rows in enumerate(parts):
        zoned.rows[SIDE, zone, 0, : len(rows)] = rows
        zoned.num_owned[zone] = len(rows)
    return zoned


def exchanged(
    partition: ZonePartition,
    halo_m: float,
    parts: Sequence[NDArray[np.void]],
    touching_m: float = 0.0,
    borders: Borders = NO_BORDERS,
    book: BorderRecords | None = None,
) -> ZoneState:
    """Return the state of a world like `zoned_of`, after its zones have exchanged ghosts."""
    zoned = zoned_of(parts)
    if book is None:
        book = make_book(1, zoned.rows.shape[-1] * partition.count)
    halo = zone_halo(partition, halo_m)
    exchange(partition.arrays, halo, touching_m, borders, zoned, SIDE, 0, 1, book)
    return zoned


def ghosts_of(zoned: ZoneState, zone: int) -> NDArray[np.void]:
    """Return the ghosts of a zone."""
    first, last = zoned.num_owned[zone, 0], zoned.num_rows[zone, 0]
    return zoned.rows[SIDE, zone, 0, first:last]
