"""Zipper merging: where two lanes become one, vehicles take turns and none of them stops.

As in SUMO, no vehicle has the right of way. Each driver follows the vehicles that pass before it,
even while these are on the other lane. Where paths of zipper links cross, drivers yield to the
vehicles that pass before them. Both drivers of a pair compute the same order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.records.arrays import RoadArrays, Scratch, TripTables
from cavmarl.driving.kernels.junctions.gaps import (
    ARRIVES_M,
    STATE_ZIPPER,
    assumed_accel_of,
    earliest,
)
from cavmarl.driving.kernels.junctions.stop_line_registration import can_be_ignored
from cavmarl.driving.kernels.models.following import behind, no_constraint

FALL_BACK_MPS2 = 0.5  # deceleration with which a driver opens a gap for the other vehicle
BRAKES_S = 1.0  # a vehicle ahead goes first if the other can brake for it within this time


@inlined_kernel
def is_zipper(roads: RoadArrays, link: int) -> bool:
    """Return whether vehicles on `link` take turns with vehicles of another lane."""
    target = roads.links[link]
    zipper: bool = (target["state"] == STATE_ZIPPER) & (target["signal"] < 0)
    return zipper


@inlined_kernel
def _can_brake_for(to_line: float, row: np.void, decel: float, ahead_m: float, mps: float) -> bool:
    """Return whether a row can fall behind another vehicle by braking briefly.

    The other vehicle is `ahead_m` m before its line and drives `mps` m/s. The result is False if
    the row is nearer to its own line.
    """
    apart = to_line - ahead_m
    brakes: bool = apart > 0.0 and apart > BRAKES_S * (row["speed"] - decel * BRAKES_S - mps)
    return brakes


@inlined_kernel
def _arrival_s(
    roads: RoadArrays, travel: TripTables, row: np.void, link: int, to_line: float
) -> float:
    """Return the shortest time in s in which a vehicle reaches its line, `to_line` m ahead."""
    limit = roads.lanes[roads.links[link]["from_lane"]]["speed_mps"]
    return earliest(to_line, row["speed"], limit, assumed_accel_of(travel, row))


@kernel
def passes_first(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,)
    row: np.void,  # VEHICLE
    link: int,  # next link of the row, a zipper link
    to_line: float,  # from the row's front to the line, m
    foe: np.void,  # APPROACH of a vehicle at another zipper link
) -> bool:
    """Return whether a foe passes a zipper before a row; the row's front is before its line."""
    foe_to_line, other = foe["dist"] - foe["half"], rows[foe["row"]]
    if foe_to_line <= 0.0:
        return True
    if can_be_ignored(other) or 0.0 < other["to_go"] < foe["dist"] + ARRIVES_M:
        return False
    decel = travel.types[row["vtype"]]["decel"]
    if _can_brake_for(to_line, row, decel, foe_to_line, other["speed"]):
        return True
    decel = travel.types[other["vtype"]]["decel"]
    if _can_brake_for(foe_to_line, other, decel, to_line, row["speed"]):
        return False
    arrives = _arrival_s(roads, travel, row, link, to_line)
    foe_arrives = _arrival_s(roads, travel, other, foe["link"], foe_to_line)
    return foe_arrives < arrives or (foe_arrives == arrives and foe["id"] < row["id"])


@kernel
def behind_in_zipper(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],  # VEHICLE (C,)
    i: int,  # row of the vehicle
    kind: np.void,  # VTYPE of the row
    link: int,  # next link of the row, a zipper link
    distance: float,  # from the row's centre to the lane's end, m; the front is before the line
    scratch: Scratch,  # with the lane and link indices of this tick
) -> float:
    """Return the constraint of the foes that pass a zipper before row i."""
    row = rows[i]
    to_line = distance - 0.5 * row["length"]
    constraint = no_constraint(kind)
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        if not (conflict["merging"] and is_zipper(roads, conflict["foe"])):
            continue
        for k in range(scratch.link_start[conflict["foe"]], scratch.link_end[conflict["foe"]]):
            foe = scratch.approach[k]
            to_clear = foe["dist"] + conflict["foe_leave_m"] + foe["half"]
            if foe["row"] == i or to_clear <= 0.0:
                continue
            if not passes_first(roads, travel, rows, row, link, to_line, foe):
                continue
            other, foe_to_line = rows[foe["row"]], foe["dist"] - foe["half"]
            left_s = _arrival_s(roads, travel, other, foe["link"], foe_to_line)
            gap = to_line + conflict["leave_m"] - to_clear + 0.5 * FALL_BACK_MPS2 * left_s * left_s
            decel = travel.types[other["vtype"]]["decel"]
            constraint = max(constraint, behind(kind, row["speed"], gap, foe["speed"], decel))
    return constraint
