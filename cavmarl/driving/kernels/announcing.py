"""Announcements of vehicles that come to a junction: others before or behind it ask for no more."""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED, HOLD_NONE, HOLD_SIGNAL

APPROACH_M = 150.0  # how far ahead a vehicle announces itself at most,
APPROACH_S = 8.0  # which it does this time before it arrives,
APPROACH_STANDING_M = 30.0  # and this far ahead in any case
STANDING_MPS = 0.5  # a slower vehicle stands, for others
IMPATIENT_S = 3.0  # a vehicle that stands this long without reason is not waited for


@inlined_kernel
def announced_m(speed: float) -> float:
    """The distance in m of its centre to a line from which on a vehicle is listed there."""
    return min(APPROACH_STANDING_M + APPROACH_S * speed, APPROACH_M)


@inlined_kernel
def is_let_stand(row: np.void) -> bool:
    """Whether others need not give way to a vehicle before a line: it stands and will not go."""
    hold = row["hold"]
    kept = (hold == HOLD_SIGNAL) | (hold == HOLD_EXIT_BLOCKED)
    idle = (hold == HOLD_NONE) & (row["wait_s"] > IMPATIENT_S)
    stands: bool = (row["speed"] <= STANDING_MPS) & (kept | idle)  # no branch has to be guessed
    return stands
