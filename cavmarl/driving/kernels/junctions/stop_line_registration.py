"""Registration of vehicles at the stop lines ahead of them, for drivers that must yield there."""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED, HOLD_NONE, HOLD_SIGNAL

APPROACH_M = 150.0  # a vehicle registers at most this far before a line,
APPROACH_S = 8.0  # and this time before it arrives there,
APPROACH_STANDING_M = 30.0  # but from this distance on in any case
STANDING_MPS = 0.5  # a slower vehicle counts as stopped
IMPATIENT_S = 3.0  # a vehicle that stands this long without reason is not waited for


@inlined_kernel
def registration_distance_m(speed: float) -> float:
    """Return the distance in m, centre to line, from which on a vehicle is registered there."""
    return min(APPROACH_STANDING_M + APPROACH_S * speed, APPROACH_M)


@inlined_kernel
def can_be_ignored(row: np.void) -> bool:
    """Return whether drivers need not yield to a vehicle at a line: it has stopped and stays."""
    hold = row["hold"]
    kept = (hold == HOLD_SIGNAL) | (hold == HOLD_EXIT_BLOCKED)
    idle = (hold == HOLD_NONE) & (row["wait_s"] > IMPATIENT_S)
    stands: bool = (row["speed"] <= STANDING_MPS) & (kept | idle)  # no branch has to be guessed
    return stands
