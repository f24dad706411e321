"""Registration of vehicles at the stop lines ahead of them, for drivers that have to yield."""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED, HOLD_NONE, HOLD_SIGNAL

APPROACH_M = 150.0  # largest distance at which a vehicle registers
APPROACH_S = 8.0  # time before the arrival at which a vehicle registers
APPROACH_STANDING_M = 30.0  # distance at which a stopped vehicle registers
STANDING_MPS = 0.5  # a slower vehicle counts as stopped
IMPATIENT_S = 3.0  # no driver waits for a vehicle that has been stopped this long without reason


@inlined_kernel
def registration_distance_m(speed: float) -> float:
    """Return the distance in m from the centre to a line at which a vehicle registers."""
    return min(APPROACH_STANDING_M + APPROACH_S * speed, APPROACH_M)


@inlined_kernel
def can_be_ignored(row: np.void) -> bool:
    """Return whether drivers need not yield to a vehicle, because it is stopped and cannot go."""
    hold = row["hold"]
    kept = (hold == HOLD_SIGNAL) | (hold == HOLD_EXIT_BLOCKED)
    idle = (hold == HOLD_NONE) & (row["wait_s"] > IMPATIENT_S)
    stands: bool = (row["speed"] <= STANDING_MPS) & (kept | idle)  # `&` avoids a branch
    return stands
