"""The kernel of the `lanes` sensor: gaps on the lanes around, and the next crossing vehicle.

The sensor `neighbors` does not show which vehicles are in the agent's way. Here, positions are
given along lanes, as in car-following models. If two vehicles are equally near, the slower vehicle
is shown, so that the order of rows does not matter.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import RoadArrays, Sensors, TripTables
from cavmarl.core.records.rows import is_off_lanes
from cavmarl.driving.kernels.junctions.gaps import is_red
from cavmarl.driving.kernels.lanes.lane_index import beside_s
from cavmarl.driving.kernels.lanes.route_following import next_step

OWN = 0  # slots of two features, gap and speed: ahead on the ego lane
LEFT = 1  # ahead on this side; the next slot is behind
RIGHT = 3
CROSSING = 10  # index of the first feature of the crossing vehicle
LANES_FEATURES = 14
SPEED_SCALE = 40.0  # m/s
HALF_M = 10.0  # a distance of this length has a closeness of 0.5
LANES_AHEAD = 8  # a path is followed over at most this many lanes
SLOWEST_MPS = 1.0  # a crossing vehicle is assumed to drive at least this fast


@kernel
def _closeness(way: float) -> np.float32:
    """Return the closeness of a distance: 1 at contact, 0.5 at `HALF_M`, towards 0 far away."""
    return np.float32(HALF_M / (HALF_M + max(way, 0.0)))


@kernel
def _scaled_speed(speed: float) -> np.float32:
    return np.float32(clamp(speed / SPEED_SCALE, -1.0, 1.0))


@kernel
def _way_between(
    roads: RoadArrays,
    travel: TripTables,
    lane: int,
    way: int,
    s: float,
    target: int,
    target_s: float,
) -> float:
    """Return the distance in m along a path from `s` on `lane` to a target; inf if not on it."""
    start = -s
    for _ in range(LANES_AHEAD):
        if lane == target:
            return start + target_s
        start += roads.lanes[lane]["length_m"]
        lane, way, _ = next_step(roads, travel, lane, way)
        if lane < 0:
            break
    return math.inf


@kernel
def _note_gap(out: NDArray[np.float32], slot: int, gap: float, speed: float) -> None:
    """Write a gap to a slot if it is the smallest so far."""
    at = 2 * slot
    closeness = _closeness(gap)
    scaled = _scaled_speed(speed)
    if closeness > out[at] or (closeness == out[at] and scaled < out[at + 1]):
        out[at] = closeness
        out[at + 1] = scaled


@kernel
def _observe_gap(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    other: np.void,
    lane: int,
    slot: int,
    range_m: float,
    out: NDArray[np.float32],
) -> None:
    """Write `other` to `slot` if it is ahead on the path from `lane`, to `slot` + 1 if behind."""
    s = row["s"] * roads.lanes[lane]["length_m"] / roads.lanes[row["lane"]]["length_m"]
    half = 0.5 * (row["length"] + other["length"])
    faster = other["speed"] - row["speed"]
    ahead = math.inf
    for on in (other["lane"], other["side_lane"]):
        if on >= 0:
            place = other["s"]
            if roads.lanes[other["lane"]]["internal"] and not roads.lanes[on]["internal"]:
                place = beside_s(roads, other["lane"], on, place)
            way = _way_between(roads, travel, lane, row["way"], s, on, place)
            if way >= 0.0:
                ahead = min(ahead, way)
    if ahead - half < range_m:
        _note_gap(out, slot, ahead - half, faster)
    elif slot != OWN:
        behind = _way_between(roads, travel, other["lane"], other["way"], other["s"], lane, s)
        if behind > 0.0 and behind - half < range_m:
            _note_gap(out, slot + 1, behind - half, faster)


@kernel
def _next_link(
    roads: RoadArrays, travel: TripTables, row: np.void, range_m: float
) -> tuple[int, float]:
    """Return a vehicle's current or next link, or -1, and the distance to its stop line in m."""
    lane = row["lane"]
    here = roads.lanes[lane]
    if here["internal"]:
        return here["link"], -(here["link_offset_m"] + row["s"])
    way = row["way"]
    distance = -row["s"]
    for _ in range(LANES_AHEAD):
        distance += roads.lanes[lane]["length_m"]
        lane, way, link = next_step(roads, travel, lane, way)
        if lane < 0 or distance > range_m:
            break
        if link >= 0:
            return link, distance
    return -1, 0.0


@kernel
def _observe_crossing(
    roads: RoadArrays,
    row: np.void,
    other: np.void,
    link: int,
    distance: float,
    foe_link: int,
    foe_distance: float,
    foe_held: bool,
    soonest: float,
    out: NDArray[np.float32],
) -> float:
    """Write `other` if it reaches an area shared by both links earlier than any vehicle so far.

    Only vehicles inside the junction, or with the right of way and without a red signal, count.
    Returns the earliest arrival in s, at most `soonest`.
    """
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        if conflict["foe"] != foe_link:
            continue
        if foe_distance > 0.0 and (foe_held or not conflict["must_yield"]):
            continue
        half = 0.5 * row["length"]
        foe_half = 0.5 * other["length"]
        if foe_distance + conflict["foe_leave_m"] + foe_half < 0.0:
            continue
        if distance + conflict["leave_m"] + half < 0.0:
            continue
        way = foe_distance + conflict["foe_enter_m"] - foe_half
        time = way / max(other["speed"], SLOWEST_MPS)
        found = (
            _closeness(distance + conflict["enter_m"] - half),
            _closeness(way),
            _scaled_speed(other["speed"]),
        )
        noted = (out[CROSSING + 1], out[CROSSING + 2], out[CROSSING + 3])
        if time < soonest or (time == soonest and found < noted):
            soonest = time
            out[CROSSING] = 1.0
            out[CROSSING + 1], out[CROSSING + 2], out[CROSSING + 3] = found
    return soonest


@kernel
def observe_lanes(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    grid: Grid,
    phase: NDArray[np.int32],
    sensors: Sensors,
    observation: NDArray[np.float32],
) -> None:
    """Write gaps and relative speeds on the lanes around, and the first vehicle across the path.

    `i`: row of the agent's vehicle. `phase`: (num_signals,) current PHASE rows. `sensors`: range
    and position of the sensor; a range of 0 switches it off. `observation`: (D,);
    `LANES_FEATURES` numbers are written, which must be 0 before.
    """
    range_m = sensors.lanes_range_m
    if range_m == 0.0:
        return
    out = observation[sensors.lanes_at : sensors.lanes_at + LANES_FEATURES]
    row = rows[i]
    here = roads.lanes[row["lane"]]
    link, distance = _next_link(roads, travel, row, range_m)
    soonest = math.inf
    first_column, last_column = cell_columns(grid, row["x"], range_m)
    first_row, last_row = cell_rows(grid, row["y"], range_m)
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = grid.bodies[b]
            dx = body["x"] - row["x"]
            dy = body["y"] - row["y"]
            if body["row"] == i or dx * dx + dy * dy > range_m * range_m:
                continue
            if abs(body["z"] - row["z"]) > LEVEL_HEIGHT_M:
                continue
            other = rows[body["row"]]
            if is_off_lanes(other):
                continue
            _observe_gap(roads, travel, row, other, row["lane"], OWN, range_m, out)
            if here["left"] >= 0:
                _observe_gap(roads, travel, row, other, here["left"], LEFT, range_m, out)
            if here["right"] >= 0:
                _observe_gap(roads, travel, row, other, here["right"], RIGHT, range_m, out)
            if link >= 0:
                foe_link, foe_distance = _next_link(roads, travel, other, range_m)
                if foe_link >= 0:
                    held = is_red(roads, foe_link, phase)
                    soonest = _observe_crossing(
                        roads,
                        row,
                        other,
                        link,
                        distance,
                        foe_link,
                        foe_distance,
                        held,
                        soonest,
                        out,
                    )
