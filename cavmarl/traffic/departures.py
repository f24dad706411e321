"""`DEPARTURE`: a vehicle that has been ordered and waits to enter; and the gate it waits at."""

from __future__ import annotations

import numpy as np

from cavmarl.kernels.arrays import Gate
from cavmarl.kernels.codes import NUM_COUNTS, NUM_SUMS

__all__ = ["DEPARTURE", "make_gate"]

DEPARTURE = np.dtype(
    [
        ("id", np.int64),  # of the vehicle; the queue is in this order
        ("agent", np.int32),  # index of the agent that will drive it, or -1
        ("lane", np.int32),  # LANE where it enters
        ("goal", np.int32),  # row of the plans' table
        ("s", np.float64),  # place on that lane, m
        ("speed_factor", np.float64),  # desired speed over the limit
        ("ordered", np.int64),  # tick
    ],
    align=True,
)


def make_gate(num_worlds: int, capacity: int) -> Gate:
    """The empty gates of `num_worlds` worlds that hold `capacity` vehicles each."""
    return Gate(
        queue=np.zeros((num_worlds, capacity), dtype=DEPARTURE),
        num_queue=np.zeros(num_worlds, dtype=np.int64),
        next_id=np.zeros(num_worlds, dtype=np.int64),
        num_entered=np.zeros(num_worlds, dtype=np.int64),
        counts=np.zeros((num_worlds, NUM_COUNTS), dtype=np.int64),
        sums=np.zeros((num_worlds, NUM_SUMS), dtype=np.float64),
    )
