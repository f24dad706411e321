"""Vehicles as frames show them: rows of one record made of those of another, in one pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel


@kernel
def write_seen(
    rows: NDArray[np.void],  # VEHICLE (n,)
    order: NDArray[np.int64],  # (n,) in which they are written
    types: NDArray[np.void],  # VTYPE (t,)
    seen: NDArray[np.void],  # SEEN (n,) is written
) -> None:
    """Copy what is seen of vehicles."""
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
