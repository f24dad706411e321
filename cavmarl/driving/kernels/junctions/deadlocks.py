"""Deadlocks of vehicles that yield to one another where no road has the right of way.

On equal roads each vehicle yields to the vehicle on its right, so a full cycle of vehicles would
wait forever. As in SUMO, each vehicle of such a cycle lets the others go in random ticks.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.rng import STREAM_DRIVER, quick_uniform
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.core.records.codes import DRIVER_BACKGROUND, HOLD_YIELD
from cavmarl.driving.kernels.junctions.stop_line_registration import STANDING_MPS, can_be_ignored

DEADLOCK_LINKS = 8  # the longest chain of yielding links that is searched
# Share of the ticks in which a deadlocked vehicle lets the others go.
STRAIGHT_SHARE = 0.25
TURNING_SHARE = 0.75
STRAIGHT = ord("s")
STATE_EQUAL = ord("=")


@inlined_kernel
def on_equal_road(roads: RoadArrays, link: int) -> bool:
    """Return whether no road has the right of way where `link` leads into the junction."""
    target = roads.links[link]
    equal: bool = (target["state"] == STATE_EQUAL) & (target["signal"] < 0)
    return equal


@inlined_kernel
def drives_as_sumo(travel: TripTables, row: np.void) -> bool:
    """Return whether a vehicle is a background vehicle with a driver model of SUMO."""
    if row["driver"] != DRIVER_BACKGROUND:
        return False
    as_sumo: bool = travel.types[row["vtype"]]["as_sumo"]
    return as_sumo


@inlined_kernel
def resolves_deadlocks(roads: RoadArrays, travel: TripTables, row: np.void, link: int) -> bool:
    """Return whether the driver of a vehicle resolves deadlocks at its next link, `link`.

    Drivers with a model of SUMO do so before a junction of equal roads.
    """
    breaks: bool = on_equal_road(roads, link) and drives_as_sumo(travel, row)
    return breaks


@kernel
def _first_foe(
    roads: RoadArrays, rows: NDArray[np.void], link: int, lane: int, scratch: Scratch
) -> int:
    """Return the link of the nearest foe that has the right of way over `link`, or -1.

    The nearest foe has the smallest distance to its stop line. If a foe comes from `lane`, the
    result is `link` itself.
    """
    nearest, nearest_m, nearest_id = -1, math.inf, 0
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        foe_link = int(roads.conflicts[c]["foe"])
        if not roads.conflicts[c]["must_yield"]:
            continue
        for k in range(scratch.link_start[foe_link], scratch.link_end[foe_link]):
            foe = scratch.approach[k]
            to_line = foe["dist"] - foe["half"]
            if to_line <= 0.0 or can_be_ignored(rows[foe["row"]]):
                continue
            if roads.links[foe_link]["from_lane"] == lane:
                return link
            first_id = to_line == nearest_m and foe["id"] < nearest_id
            if to_line < nearest_m or first_id:
                nearest, nearest_m, nearest_id = foe_link, to_line, foe["id"]
    return nearest


@kernel
def is_deadlocked(roads: RoadArrays, rows: NDArray[np.void], link: int, scratch: Scratch) -> bool:
    """Return whether a chain of yielding vehicles leads from `link` back to its own lane."""
    lane, at = roads.links[link]["from_lane"], link
    for _ in range(DEADLOCK_LINKS):
        following = _first_foe(roads, rows, at, lane, scratch)
        if following == at:
            return True
        if following < 0:
            return False
        at = following
    return False


@kernel
def yields_in_deadlock(
    roads: RoadArrays,
    rows: NDArray[np.void],
    row: np.void,  # VEHICLE
    link: int,  # next LINK of the vehicle
    asking: np.void,  # VEHICLE whose driver asks: `row`, or a vehicle that yields to it
    scratch: Scratch,
) -> bool:
    """Return whether a driver that resolves deadlocks is in a deadlock and now lets others go."""
    if row["hold"] != HOLD_YIELD or row["speed"] > STANDING_MPS or row["wait_s"] == 0.0:
        return False
    share = STRAIGHT_SHARE if roads.links[link]["direction"] == STRAIGHT else TURNING_SHARE
    if quick_uniform(asking["rng_key"], row["id"], asking["tick"], STREAM_DRIVER + 1) >= share:
        return False
    waits: bool = is_deadlocked(roads, rows, link, scratch)
    return waits
