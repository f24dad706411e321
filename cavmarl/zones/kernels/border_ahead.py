"""Vehicles that drive to a border of their zone: where their way crosses it, and to which zone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.geometry import lane_pose
from cavmarl.core.records import record
from cavmarl.core.records.arrays import RoadArrays, Travel, Zoned
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND
from cavmarl.core.records.rows import is_lost
from cavmarl.driving.kernels.held_vehicles import stopping_m
from cavmarl.driving.kernels.lanes.route_following import next_step_of_plan
from cavmarl.zones.kernels.zone_lookup import ZoneArrays, squared_distance, zone_of

AHEAD = record(
    ("vehicle", np.int64),
    ("source", np.int64),  # zone that owns it
    ("row", np.int64),  # where the owner keeps it
    ("target", np.int64),  # zone that it would enter
    ("gap_m", np.float64),  # from its front to the border
    ("depth_m", np.float64),  # how far it has to go to the target, less than 0
    ("can_stop", np.bool_),  # in comfort, before the border
    ("has_to_brake", np.bool_),  # about now, to do so
)

STRIDE_M = 1.0  # between the places of a way that are looked at
BEYOND_M = 50.0  # a way that has not gone so deep as the hysteresis so far behind a border
MARGIN_M = 10.0  # a vehicle is told of so far before it has to brake


@kernel
def find_ahead(
    zones: ZoneArrays,
    hysteresis_m: float,  # so far outside of its zone a vehicle still stays with it
    roads: RoadArrays,
    travel: Travel,
    zoned: Zoned,  # the rows of all zones
    side: int,  # whose rows, 0 or 1
    w: int,
    patience_s: float,  # for so long a vehicle drives on without an acknowledgement
    more_m: float,  # so much earlier than it has to brake a vehicle is told of
    out: NDArray[np.void],  # AHEAD (C,) overwritten, by zones and rows
) -> int:
    """The vehicles whose way soon crosses a border of their zone; how many there are.

    These are vehicles that drive themselves or are steered, inside of their zone, which would have
    to brake for the border within `patience_s`, or a little later.
    """
    found = 0
    for zone in range(zones.rects.shape[0]):
        for i in range(zoned.num_owned[zone, w]):
            row = zoned.rows[side, zone, w, i]
            if row["driver"] != DRIVER_BACKGROUND and row["driver"] != DRIVER_AGENT:
                continue
            kind = travel.types[row["vtype"]]
            speed = max(row["speed"], 0.0)
            look = MARGIN_M + more_m + 0.5 * row["length"]
            look += speed * patience_s + stopping_m(kind, speed)
            if is_lost(row) or not _near_rim(zones.rects[zone], row["x"], row["y"], look):
                continue
            inside, target = _crossing(zones, hysteresis_m, roads, travel, row, zone, look)
            if target < 0:
                continue
            entry = out[found]
            gap = inside - 0.5 * row["length"]
            entry["vehicle"] = row["id"]
            entry["source"] = zone
            entry["row"] = i
            entry["target"] = target
            entry["gap_m"] = gap
            entry["depth_m"] = -math.sqrt(squared_distance(zones.rects, target, row["x"], row["y"]))
            entry["has_to_brake"] = inside <= look - more_m
            entry["can_stop"] = gap > 0.0 and speed * speed <= 2.0 * kind["decel"] * gap
            found += 1
    return found


@kernel
def close_edges(
    zones: ZoneArrays,
    roads: RoadArrays,
    zone: int,
    closed: NDArray[np.int64],  # (num_edges,) bits of classes; those of all are set
) -> None:
    """Close all edges of which any part lies in a zone."""
    for lane in range(roads.lanes.shape[0]):
        here = roads.lanes[lane]
        s = 0.0
        while True:
            pose = lane_pose(roads.points, here["first_point"], here["num_points"], s)
            if zone_of(zones, pose[0], pose[1]) == zone:
                closed[here["edge"]] = -1
            if s >= here["length_m"]:
                break
            s = min(s + STRIDE_M, here["length_m"])


@kernel
def _near_rim(rect: NDArray[np.float64], x: float, y: float, look: float) -> bool:
    """Whether a place is inside of a zone, and so near to its rim."""
    if not (rect[0] <= x and x <= rect[2] and rect[1] <= y and y <= rect[3]):
        return False
    least = min(min(x - rect[0], rect[2] - x), min(y - rect[1], rect[3] - y))
    near: bool = least <= look
    return near


@kernel
def _crossing(
    zones: ZoneArrays,
    hysteresis_m: float,
    roads: RoadArrays,
    travel: Travel,
    row: np.void,
    zone: int,
    look: float,
) -> tuple[float, int]:
    """Metres from a vehicle's centre to where its way last is inside of its zone, and the next one.

    The next zone is -1 if the way crosses no border within `look` m.
    """
    limit = hysteresis_m * hysteresis_m
    lane = row["lane"]
    way = row["way"]
    begin = -row["s"]  # m from the centre to the start of the lane
    s = math.floor(row["s"] / STRIDE_M) * STRIDE_M
    inside = 0.0
    for _ in range(roads.lanes.shape[0]):
        here = roads.lanes[lane]
        while s < here["length_m"]:
            s = min(s + STRIDE_M, here["length_m"])
            pose = lane_pose(roads.points, here["first_point"], here["num_points"], s)
            squared = squared_distance(zones.rects, zone, pose[0], pose[1])
            if squared > limit:
                return inside, zone_of(zones, pose[0], pose[1])
            if squared == 0.0:
                inside = begin + s
            if inside > look or begin + s > look + BEYOND_M:
                return inside, -1
        begin += here["length_m"]
        s = 0.0
        lane, way, _ = next_step_of_plan(roads, travel, lane, way)
        if lane < 0:
            break
    return inside, -1
