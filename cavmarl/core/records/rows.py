"""What a vehicle's row says of its place, asked by more than one domain."""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_SCRIPTED

ENTER_REACH_M = 80.0  # how far along its lane a departing vehicle looks for others
SIZE_LENGTHS_M = (5.5, 8.0)  # longer vehicles are of the next size class: car, van or truck, bus
SIZE_BODIES_M = (
    5.1,
    7.6,
    12.2,
)  # the length that a vehicle of each class is taken to have at least
STEERED = 3  # the class of a car that is steered, of SWEEP rows that say where it sweeps
WAIT_SLACK_M = 0.5  # a front this far beyond a waiting position inside a junction still waits there
MERGES_M = 300.0  # before its line one is minded by those that turn into its lane
SWEPT_BEYOND_M = 9.0  # how far beyond a junction others may still mind a vehicle's rear
FORK_BEYOND_M = 3.0  # how far beyond a junction paths from one lane can still run together
LOST_M = (
    10.0  # from its place on its lane: a vehicle that is steered off further is no longer there
)
OFF_LANES_M = 1.5  # from the middle of the nearest lane


@inlined_kernel
def is_lost(row: np.void) -> bool:
    """Whether a vehicle was steered away from its lane, and onto no other: against the traffic.

    No other vehicle on that lane has to mind it any more.
    """
    lost: bool = abs(row["d"]) > LOST_M and row["driver"] == DRIVER_AGENT
    return lost


@inlined_kernel
def is_off_lanes(row: np.void) -> bool:
    """Whether a row's lane is only the nearest one, or the last one that it was on."""
    off: bool = row["driver"] == DRIVER_SCRIPTED and abs(row["d"]) > OFF_LANES_M
    return off or is_lost(row)
