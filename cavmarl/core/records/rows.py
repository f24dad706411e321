"""Predicates of a vehicle's row about its position, used by several folders."""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import inlined_kernel
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    DRIVER_EXTERNAL,
    DRIVER_LEARNED,
    DRIVER_SCRIPTED,
)

ENTER_REACH_M = 80.0  # how far ahead along its lane a departing vehicle looks for others
SIZE_LENGTHS_M = (5.5, 8.0)  # longer vehicles are in the next class: car; van or truck; bus
SIZE_BODIES_M = (
    5.1,
    7.6,
    12.2,
)  # assumed minimum length of a vehicle of each class
STEERED = 3  # class of a steered car, in SWEEP rows about the area that it sweeps
WAIT_SLACK_M = 0.5  # a front this far beyond a waiting position inside a junction still waits there
MERGES_M = 300.0  # a vehicle this close to a line is watched by vehicles that turn into its lane
SWEPT_BEYOND_M = 9.0  # other drivers may watch a vehicle until its rear is this far past a junction
FORK_BEYOND_M = 3.0  # how far beyond a junction paths from one lane can still overlap
LOST_M = 10.0  # a steered or a caller's vehicle farther from its lane than this is on no lane
OFF_LANES_M = 1.5  # a scripted vehicle farther from the middle of its lane is off the lanes


@inlined_kernel
def is_steered(row: np.void) -> bool:
    """Return whether a policy or a network steers a vehicle, which can leave its lane."""
    steered: bool = row["driver"] == DRIVER_AGENT or row["driver"] == DRIVER_LEARNED
    return steered


@inlined_kernel
def is_lost(row: np.void) -> bool:
    """Return whether a steered vehicle or a vehicle of the caller is on no lane.

    Its row names its last or its nearest lane; vehicles on that lane ignore it.
    """
    is_free: bool = is_steered(row) or row["driver"] == DRIVER_EXTERNAL
    lost: bool = abs(row["d"]) > LOST_M and is_free
    return lost


@inlined_kernel
def is_off_lanes(row: np.void) -> bool:
    """Return whether a vehicle `is_lost`, or is scripted and off the lane that its row names."""
    off: bool = row["driver"] == DRIVER_SCRIPTED and abs(row["d"]) > OFF_LANES_M
    return off or is_lost(row)
