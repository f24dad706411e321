"""`DEPARTURE`: a vehicle that has been ordered and waits to enter."""

from __future__ import annotations

import numpy as np

__all__ = ["DEPARTURE"]

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
