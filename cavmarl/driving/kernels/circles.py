"""Circles of vehicles that wait for one another where no road has the right of way.

On equal roads each gives way to the one on its right, and so all around. As in SUMO some of those
that stand in such a circle let the others go, by chance in each tick.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.rng import STREAM_DRIVER, quick_uniform
from cavmarl.core.records.arrays import RoadArrays, Scratch, Travel
from cavmarl.core.records.codes import DRIVER_BACKGROUND, HOLD_YIELD, MODEL_KRAUSS
from cavmarl.driving.kernels.announcing import STANDING_MPS, is_let_stand

CIRCLE_LINKS = 8  # looked along for a circle
STRAIGHT_SHARE = 0.25  # of the ticks in which one that waits in a circle lets the others go,
TURNING_SHARE = 0.75  # and where it turns
STRAIGHT = ord("s")
STATE_EQUAL = ord("=")


@inlined_kernel
def on_equal_road(roads: RoadArrays, link: int) -> bool:
    """Whether no road has the right of way where `link` leads into the junction."""
    target = roads.links[link]
    equal: bool = (target["state"] == STATE_EQUAL) & (target["signal"] < 0)
    return equal


@inlined_kernel
def drives_as_sumo(travel: Travel, row: np.void) -> bool:
    """Whether a vehicle has a driver that SUMO has, too: Krauss's, in the background."""
    if row["driver"] != DRIVER_BACKGROUND:
        return False
    krauss: bool = travel.types[row["vtype"]]["model"] == MODEL_KRAUSS
    return krauss


@inlined_kernel
def breaks_circles(roads: RoadArrays, travel: Travel, row: np.void, link: int) -> bool:
    """Whether a vehicle is one whose driver counts with circles where it takes `link` next.

    They are the drivers that SUMO has, before a junction without any right of way.
    """
    breaks: bool = on_equal_road(roads, link) and drives_as_sumo(travel, row)
    return breaks


@kernel
def _first_foe(
    roads: RoadArrays, rows: NDArray[np.void], link: int, lane: int, scratch: Scratch
) -> int:
    """The link of the one, of all that `link` gives way to, that is nearest to its line, or -1.

    `link` itself where it gives way to any from `lane`.
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
            if to_line <= 0.0 or is_let_stand(rows[foe["row"]]):
                continue
            if roads.links[foe_link]["from_lane"] == lane:
                return link
            first_id = to_line == nearest_m and foe["id"] < nearest_id
            if to_line < nearest_m or first_id:
                nearest, nearest_m, nearest_id = foe_link, to_line, foe["id"]
    return nearest


@kernel
def waits_in_circle(roads: RoadArrays, rows: NDArray[np.void], link: int, scratch: Scratch) -> bool:
    """Whether one at `link` gives way to one that, over others or not, gives way to its lane."""
    lane, at = roads.links[link]["from_lane"], link
    for _ in range(CIRCLE_LINKS):
        following = _first_foe(roads, rows, at, lane, scratch)
        if following == at:
            return True
        if following < 0:
            return False
        at = following
    return False


@kernel
def lets_go(
    roads: RoadArrays,
    rows: NDArray[np.void],
    row: np.void,  # VEHICLE
    link: int,  # that it takes next
    asking: np.void,  # VEHICLE that asks: itself, or one that gives way to it
    scratch: Scratch,
) -> bool:
    """Whether one that `breaks_circles` stands in one before `link`, and lets the others go."""
    if row["hold"] != HOLD_YIELD or row["speed"] > STANDING_MPS or row["wait_s"] == 0.0:
        return False
    share = STRAIGHT_SHARE if roads.links[link]["direction"] == STRAIGHT else TURNING_SHARE
    if quick_uniform(asking["rng_key"], row["id"], asking["tick"], STREAM_DRIVER + 1) >= share:
        return False
    waits: bool = waits_in_circle(roads, rows, link, scratch)
    return waits
