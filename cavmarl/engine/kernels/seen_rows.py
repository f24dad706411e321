"""Conversion of vehicle records for frames and recordings, in one pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel

_BLOCK = 512  # rows that fit into the cache while they are split


@kernel
def split_rows(
    raw: NDArray[np.uint8],  # (n, size of a row)
    offsets: NDArray[np.int64],  # (C + 1,) offset of each field in a row, and the size of a row
    starts: NDArray[np.int64],  # (C,) offset of its column in `out`
    out: NDArray[np.uint8],  # is written
) -> None:
    """Split packed rows into columns, while other threads run Python."""
    for first in range(0, raw.shape[0], _BLOCK):
        last = min(first + _BLOCK, raw.shape[0])
        for c in range(starts.size):
            at = starts[c] + first * (offsets[c + 1] - offsets[c])
            for k in range(first, last):
                for byte in range(offsets[c], offsets[c + 1]):
                    out[at] = raw[k, byte]
                    at += 1


@kernel
def write_seen(
    rows: NDArray[np.void],  # VEHICLE (n,)
    order: NDArray[np.int64],  # (n,) the row for each place of `seen`
    types: NDArray[np.void],  # VTYPE (t,)
    seen: NDArray[np.void],  # SEEN (n,) is written
) -> None:
    """Copy the fields of SEEN from vehicles."""
    for k in range(order.size):
        row, out = rows[order[k]], seen[k]
        out.id = row.id
        out.x, out.y, out.z = row.x, row.y, row.z
        out.heading, out.pitch = row.heading, row.pitch
        out.speed, out.accel, out.steering = row.speed, row.accel, row.steering
        out.distance_m, out.to_go = row.distance_m, row.to_go
        out.length, out.width, out.height = row.length, row.width, row.height
        out.lane, out.agent, out.events = row.lane, row.agent, row.events
        out.vclass = types[row.vtype].vclass
        out.zone, out.target_zone, out.transfer = row.owner, row.target_zone, row.transfer
        out.driver, out.blinker = row.driver, row.blinker
