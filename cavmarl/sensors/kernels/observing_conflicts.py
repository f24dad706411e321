"""The kernel of the `conflicts` sensor: the vehicles that come closest to the ego path.

All vehicles are assumed to keep their speed: the ego vehicle along its path, others straight
along their headings, because their plans are unknown. Every 0.5 s of the horizon, the kernel
computes the gap between the two bodies, as boxes along the ego axes. The vehicle whose approach is
closest and soonest comes first. The right of way depends on the lane of the other vehicle,
whichever link it takes from there.

With `indicators`, other vehicles are assumed to follow their lanes and, over the current or next
junction, the link that they indicate. After that they go straight. A vehicle farther from its
junction than `indicators_m` does not indicate yet, and is assumed to go straight over it.

With `departs`, the ego vehicle is assumed to accelerate to the speed limit of its lane, so a
vehicle that waits at a junction observes what it would meet if it went now.

With `heard`, vehicles that are known only from a message are included; their positions are
extrapolated from the position and speed in the message. Their lanes are unknown.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cosine, sine
from cavmarl.core.math.geometry import lane_pose
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.math.walls import Walls, is_cut
from cavmarl.core.records import record
from cavmarl.core.records.arrays import RoadArrays, TripTables
from cavmarl.core.records.codes import (
    DRIVER_SCRIPTED,
    SIGNAL_GREEN_MAJOR,
)
from cavmarl.core.records.rows import is_off_lanes
from cavmarl.driving.kernels.junctions.gaps import is_red, link_signal
from cavmarl.driving.kernels.lanes.route_following import next_step_of_plan
from cavmarl.sensors.kernels.observing_way import MOST_LANES

CONFLICT_FEATURES = 9
HEARD_FEATURES = 2  # additional features with `heard`
INDICATED_FEATURES = 1  # additional features with `indicators`
INDICATED_RAD = 0.4  # a link that turns by less is not indicated
AGE_SCALE_S = 1.0
LOOK_S = 0.5  # time between predicted moments
DEPART_MPS2 = 2.0  # assumed acceleration with `departs`
SLOWEST_MPS = 3.0  # the ego vehicle is assumed to drive at least this fast, even if stopped
WAIT_MPS = 2.0  # in the ranking, an approach 1 s later counts as this many metres farther
GAP_HALF_M = 2.0  # a gap of this length has a closeness of 0.5
WHEN_HALF_S = 2.0  # a time of this length has a soonness of 0.5
PLACE_HALF_M = 10.0  # a distance of this length is scaled to 0.5
SPEED_HALF_MPS = 10.0  # a relative speed of this size is scaled to 0.5


RANKED = record(
    ("counts", np.float64),  # m, rank: smaller comes first
    ("near", np.float64),  # m, the gap of the nearest approach
    ("when", np.float64),  # s until the nearest approach
    ("id", np.int64),
    ("body", np.int64),  # index in `Grid.bodies`, or -1 - k for `ConflictsSensor.told[k]`
)


class ConflictsSensor(NamedTuple):
    """Settings and scratch of the `conflicts` sensor."""

    at: int
    most: int  # vehicles per observation; 0: off
    range_m: float
    walls: Walls  # walls that hide vehicles
    heard: bool  # whether vehicles known only from messages are included
    told: NDArray[np.void]  # BODY (inbox,) scratch: current positions of the vehicles in messages
    indicators: bool  # whether other vehicles indicate their link over the next junction
    indicators_m: float  # distance to the junction within which they indicate it; 0: any
    departs: bool  # whether the ego vehicle is assumed to accelerate to the speed limit
    looks: NDArray[np.float64]  # (L, 4) scratch: predicted poses of the ego vehicle
    heard_looks: NDArray[np.float64]  # (L, 4) scratch: poses of a vehicle in a message
    others: NDArray[np.float64]  # (capacity, L, 4) scratch: poses of `Grid.bodies`
    indicated: NDArray[np.float64]  # (capacity,) indicated turn of each body: 1 left, -1 right
    foreseen: NDArray[np.int64]  # (capacity,) the `filling` for which each body was predicted
    filling: NDArray[np.int64]  # (1,) how many times the grid has been filled
    ranked: NDArray[np.void]  # RANKED (count,) scratch


@kernel
def _saturate(value: float, half: float) -> float:
    """Map a value to (-1, 1): 0.5 at `half`, -0.5 at `-half`."""
    return value / (half + abs(value))


@kernel
def _driven(look: int, speed: float, most_speed: float) -> float:
    """Return the distance at a predicted moment: from `speed`, accelerating to `most_speed`."""
    time = LOOK_S * look
    if speed >= most_speed:
        return speed * time
    gaining = min((most_speed - speed) / DEPART_MPS2, time)
    top = speed + DEPART_MPS2 * gaining
    return 0.5 * (speed + top) * gaining + top * (time - gaining)


@kernel
def _predict_on_path(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,
    speed: float,
    most_speed: float,
    num_links: int,
    looks: NDArray[np.float64],
) -> tuple[int, bool]:
    """Predict a vehicle's poses; `looks` (L, 4) gets x, y, cos and sin.

    The vehicle accelerates from `speed` to `most_speed`, or keeps a speed that is not lower.

    It follows its path over at most `num_links` links, then goes straight. Returns the
    first of these links (-1: none), and whether the vehicle is on it.
    """
    looks[0, 0] = row["x"]
    looks[0, 1] = row["y"]
    looks[0, 2] = cosine(row["heading"])
    looks[0, 3] = sine(row["heading"])
    num_looks = looks.shape[0]
    lane, way = row["lane"], row["way"]
    here = roads.lanes[lane]
    crossed = here["link"] if here["internal"] else -1
    is_on = crossed >= 0
    left = num_links - int(is_on)
    start = -row["s"]
    written = 1
    for _ in range(MOST_LANES):
        end = start + here["length_m"]
        following, way_there, link = next_step_of_plan(roads, travel, lane, way)
        if link >= 0:
            following = following if left > 0 else -1
            left -= 1
        while written < num_looks:
            driven = _driven(written, speed, most_speed)
            if driven > end and following >= 0:
                break
            x, y, _, cos, sin, _ = lane_pose(
                roads.points, here["first_point"], here["num_points"], driven - start
            )
            looks[written, 0] = x
            looks[written, 1] = y
            looks[written, 2] = cos
            looks[written, 3] = sin
            written += 1
        if crossed < 0 and link >= 0 and following >= 0:
            crossed = link
        if written == num_looks or following < 0:
            break
        lane, way, start = following, way_there, end
        here = roads.lanes[lane]
    # If the path has too many short lanes, the prediction stops at the last one.
    for k in range(written, num_looks):
        for axis in range(4):
            looks[k, axis] = looks[written - 1, axis]
    return crossed, is_on


@kernel
def _predict_straight(body: np.void, looks: NDArray[np.float64]) -> None:
    """Predict the poses of a body that keeps its speed and heading."""
    for k in range(looks.shape[0]):
        time = LOOK_S * k
        looks[k, 0] = body["x"] + time * body["speed"] * body["cos"]
        looks[k, 1] = body["y"] + time * body["speed"] * body["sin"]
        looks[k, 2] = body["cos"]
        looks[k, 3] = body["sin"]


@kernel
def _turn_of(roads: RoadArrays, link: int) -> float:
    """Return 1 if a link turns left, -1 if it turns right, 0 otherwise or without a link."""
    if link < 0:
        return 0.0
    before = roads.lanes[roads.links[link]["from_lane"]]
    after = roads.lanes[roads.links[link]["to_lane"]]
    first, num = before["first_point"], before["num_points"]
    _, _, _, cos, sin, _ = lane_pose(roads.points, first, num, before["length_m"])
    first, num = after["first_point"], after["num_points"]
    _, _, _, cos_after, sin_after, _ = lane_pose(roads.points, first, num, 0.0)
    turns = atan2(sin_after * cos - cos_after * sin, cos_after * cos + sin_after * sin)
    if abs(turns) < INDICATED_RAD:
        return 0.0
    return 1.0 if turns > 0.0 else -1.0


@kernel
def _indicates(
    roads: RoadArrays, travel: TripTables, row: np.void, sensor: ConflictsSensor
) -> bool:
    """Return whether a vehicle is on a junction, or near enough to the next one to indicate."""
    lane, way = row["lane"], row["way"]
    if sensor.indicators_m == 0.0 or roads.lanes[lane]["internal"]:
        return True
    distance = -row["s"]
    for _ in range(MOST_LANES):
        distance += roads.lanes[lane]["length_m"]
        if distance > sensor.indicators_m:
            return False
        lane, way, link = next_step_of_plan(roads, travel, lane, way)
        if link >= 0 or lane < 0:
            return bool(link >= 0)
    return False


@kernel
def forget_others(sensor: ConflictsSensor) -> None:
    """Mark all predictions as outdated; call this after the grid has been filled again."""
    sensor.filling[0] += 1


@kernel
def _predict_other(
    roads: RoadArrays,
    travel: TripTables,
    other: np.void,
    body: np.void,
    at: int,
    sensor: ConflictsSensor,
) -> None:
    """Predict the poses of body `at` of the grid, once for all agents that see it."""
    if sensor.foreseen[at] == sensor.filling[0]:
        return
    sensor.foreseen[at] = sensor.filling[0]
    sensor.indicated[at] = 0.0
    if sensor.indicators and other["driver"] != DRIVER_SCRIPTED and not is_off_lanes(other):
        links = 1 if _indicates(roads, travel, other, sensor) else 0
        speed = other["speed"]
        link, _ = _predict_on_path(roads, travel, other, speed, speed, links, sensor.others[at])
        sensor.indicated[at] = _turn_of(roads, link)
    else:
        _predict_straight(body, sensor.others[at])


@kernel
def _nearest_approach(
    row: np.void, body: np.void, looks: NDArray[np.float64], others: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the gap in m and the time in s of the most critical approach between two boxes.

    The gap is the sum of the gaps along and across the ego vehicle; later gaps count as larger.
    `looks`, `others` (L, 4): predicted poses of the ego vehicle and of the body.
    """
    half_length = 0.5 * row["length"]
    half_width = 0.5 * row["width"]
    best = math.inf
    near = 0.0
    when = 0.0
    for k in range(looks.shape[0]):
        time = LOOK_S * k
        cos, sin = looks[k, 2], looks[k, 3]
        dx = others[k, 0] - looks[k, 0]
        dy = others[k, 1] - looks[k, 1]
        along = abs(dx * cos + dy * sin)
        across = abs(dy * cos - dx * sin)
        same = abs(others[k, 2] * cos + others[k, 3] * sin)
        turned = abs(others[k, 3] * cos - others[k, 2] * sin)
        along -= half_length + same * body["half_length"] + turned * body["half_width"]
        across -= half_width + turned * body["half_length"] + same * body["half_width"]
        gap = max(along, 0.0) + max(across, 0.0)
        if gap + WAIT_MPS * time < best:
            best = gap + WAIT_MPS * time
            near = gap
            when = time
    return near, when


@kernel
def _right_of_way(
    roads: RoadArrays, link: int, is_on: bool, other: np.void, phase: NDArray[np.int32]
) -> float:
    """Return 1 if the other vehicle has priority over `link`, -1 if it must yield, else 0.

    The other vehicle has priority if its link, or a link that it may take, goes before `link`.
    """
    if link < 0 or is_off_lanes(other):
        return 0.0
    there = roads.lanes[other["lane"]]
    is_held = is_red(roads, link, phase)
    is_protected = link_signal(roads, link, phase) == SIGNAL_GREEN_MAJOR
    gives_way = False
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        conflict = roads.conflicts[c]
        foe = conflict["foe"]
        if there["internal"]:
            if foe == there["link"]:
                return 0.0 if is_on else 1.0
        elif roads.links[foe]["from_lane"] == other["lane"]:
            foe_is_held = is_red(roads, foe, phase)
            if is_on or foe_is_held:
                gives_way = gives_way or is_on or not is_held
            elif is_held or (conflict["must_yield"] and not is_protected):
                return 1.0
            else:
                gives_way = True
    return -1.0 if gives_way else 0.0


@kernel
def _take_reports(
    reports: NDArray[np.void], tick: int, tick_s: float, told: NDArray[np.void]
) -> int:
    """Convert the vehicles in `reports` (N,) to BODY `told` (N,) and return their number."""
    for k in range(reports.size):
        report = reports[k]
        if report["sender"] < 0:
            return k
        body = told[k]
        gone_m = (tick - report["tick"]) * tick_s * report["speed"]
        body["id"] = report["subject"]
        body["row"] = k
        body["cos"] = cosine(report["heading"])
        body["sin"] = sine(report["heading"])
        body["x"] = report["x"] + gone_m * body["cos"]
        body["y"] = report["y"] + gone_m * body["sin"]
        body["z"] = report["z"]
        body["speed"] = report["speed"]
        body["half_length"] = 0.5 * report["length"]
        body["half_width"] = 0.5 * report["width"]
    return int(reports.size)


@kernel
def _is_near(row: np.void, body: np.void, range_m: float) -> bool:
    dx = body["x"] - row["x"]
    dy = body["y"] - row["y"]
    if not dx * dx + dy * dy <= range_m * range_m:
        return False
    return bool(abs(body["z"] - row["z"]) <= LEVEL_HEIGHT_M)


@kernel
def _insert(
    row: np.void,
    body: np.void,
    others: NDArray[np.float64],
    at: int,
    found: int,
    sensor: ConflictsSensor,
) -> int:
    """Insert a body into the ranking of `found` vehicles and return their new number."""
    near, when = _nearest_approach(row, body, sensor.looks, others)
    counts = near + WAIT_MPS * when
    place = found
    while place > 0:
        other = sensor.ranked[place - 1]
        if counts > other["counts"] or (counts == other["counts"] and body["id"] > other["id"]):
            break
        place -= 1
    if place == sensor.most:
        return found
    if found < sensor.most:
        found += 1
    for k in range(found - 1, place, -1):
        sensor.ranked[k] = sensor.ranked[k - 1]
    ranked = sensor.ranked[place]
    ranked["counts"] = counts
    ranked["near"] = near
    ranked["when"] = when
    ranked["id"] = body["id"]
    ranked["body"] = at
    return found


@kernel
def _rank(
    roads: RoadArrays,
    travel: TripTables,
    grid: Grid,
    rows: NDArray[np.void],
    i: int,
    num_told: int,
    sensor: ConflictsSensor,
) -> int:
    """Rank the vehicles into the sensor's scratch by their approach, then by id."""
    row = rows[i]
    first_column, last_column = cell_columns(grid, row["x"], sensor.range_m)
    first_row, last_row = cell_rows(grid, row["y"], sensor.range_m)
    found = 0
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = grid.bodies[b]
            if body["row"] == i or not _is_near(row, body, sensor.range_m):
                continue
            if is_cut(sensor.walls, row["x"], row["y"], body["x"], body["y"]):
                continue
            _predict_other(roads, travel, rows[body["row"]], body, b, sensor)
            found = _insert(row, body, sensor.others[b], b, found, sensor)
            for k in range(num_told):
                if sensor.told[k]["id"] == body["id"]:
                    sensor.told[k]["id"] = -1  # the vehicle is seen
    for k in range(num_told):
        body = sensor.told[k]
        if body["id"] < 0 or body["id"] == row["id"] or not _is_near(row, body, sensor.range_m):
            continue
        _predict_straight(body, sensor.heard_looks)
        found = _insert(row, body, sensor.heard_looks, -1 - k, found, sensor)
    return found


@kernel
def observe_conflicts(
    roads: RoadArrays,
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    grid: Grid,
    phase: NDArray[np.int32],
    reports: NDArray[np.void],
    tick: int,
    tick_s: float,
    sensor: ConflictsSensor,
    observation: NDArray[np.float32],
) -> None:
    """Write nine to twelve numbers per vehicle, by rank; numbers of missing vehicles are 0.

    `i`: row of the agent's vehicle. `phase`: (num_signals,) current PHASE rows. `reports`: REPORT
    (N,) of vehicles in the agent's inbox; read only with `heard`. `tick`: the world's tick.
    """
    row = rows[i]
    speed = most_speed = max(row["speed"], SLOWEST_MPS)
    if sensor.departs:
        speed, most_speed = row["speed"], roads.lanes[row["lane"]]["speed_mps"]
    link, is_on = _predict_on_path(roads, travel, row, speed, most_speed, MOST_LANES, sensor.looks)
    num_told = _take_reports(reports, tick, tick_s, sensor.told) if sensor.heard else 0
    found = _rank(roads, travel, grid, rows, i, num_told, sensor)
    cos_heading = sensor.looks[0, 2]
    sin_heading = sensor.looks[0, 3]
    size = CONFLICT_FEATURES + (HEARD_FEATURES if sensor.heard else 0)
    size += INDICATED_FEATURES if sensor.indicators else 0
    for k in range(found):
        ranked = sensor.ranked[k]
        is_seen = ranked["body"] >= 0
        body = grid.bodies[ranked["body"]] if is_seen else sensor.told[-1 - ranked["body"]]
        dx = body["x"] - row["x"]
        dy = body["y"] - row["y"]
        dvx = body["speed"] * body["cos"] - row["speed"] * cos_heading
        dvy = body["speed"] * body["sin"] - row["speed"] * sin_heading
        at = sensor.at + size * k
        out = observation[at : at + size]
        out[0] = GAP_HALF_M / (GAP_HALF_M + ranked["near"])
        out[1] = WHEN_HALF_S / (WHEN_HALF_S + ranked["when"])
        out[2] = _saturate(dx * cos_heading + dy * sin_heading, PLACE_HALF_M)
        out[3] = _saturate(dy * cos_heading - dx * sin_heading, PLACE_HALF_M)
        out[4] = _saturate(dvx * cos_heading + dvy * sin_heading, SPEED_HALF_MPS)
        out[5] = _saturate(dvy * cos_heading - dvx * sin_heading, SPEED_HALF_MPS)
        out[6] = min(max(body["cos"] * cos_heading + body["sin"] * sin_heading, -1.0), 1.0)
        out[7] = min(max(body["sin"] * cos_heading - body["cos"] * sin_heading, -1.0), 1.0)
        if is_seen:
            out[8] = _right_of_way(roads, link, is_on, rows[body["row"]], phase)
        if sensor.heard and is_seen:
            out[9] = 1.0
        elif sensor.heard:
            age_s = (tick - reports[body["row"]]["tick"]) * tick_s
            out[10] = min(age_s / AGE_SCALE_S, 1.0)
        if sensor.indicators and is_seen:
            out[size - 1] = sensor.indicated[ranked["body"]]
