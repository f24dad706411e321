"""Rows that the caller poses or drives: motion, positions on the lanes, and new rows.

The lane of such a row depends only on its pose. A body that touches no lane is assigned to the
nearest lane, at a distance above `LOST_M`, so that drivers ignore it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import atan, cos_sin
from cavmarl.core.math.geometry import lane_pose, project, wrap_angle
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import DepartureQueue, LaneGrid, RoadArrays, TripTables, ZoneState
from cavmarl.core.records.codes import DRIVER_EXTERNAL, EVENT_ARRIVED
from cavmarl.core.records.external_records import EXTERNAL_DRIVEN, FIRST_EXTERNAL_ID
from cavmarl.core.records.rows import LOST_M
from cavmarl.driving.kernels.lanes.route_following import free_speed
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS, account, before_tick
from cavmarl.driving.kernels.motion.tracking import LEVEL_M, side_lane

OFF_M = LOST_M + 1.0  # smallest distance from its lane of a body that touches no lane
# Penalties on the distance of a lane: the body does not touch it, its centre is not on it, or it
# leads in the opposite direction.
UNTOUCHED_M = 1000.0
BESIDE_M = 100.0
OPPOSITE_M = 20.0
ASKEW_M = 4.0  # penalty: this times 1 - cos of the angle to the lane


@inlined_kernel
def _is_within(grid: LaneGrid, column: int, line: int) -> bool:
    return 0 <= column < grid.num_x and 0 <= line < grid.num_y


@kernel
def find_place(roads: RoadArrays, grid: LaneGrid, row: np.void) -> bool:
    """Set lane, s, d, link and side lane of a body by its pose; return whether it is on a lane."""
    column = int((row["x"] - grid.min_x) // grid.cell_m)
    line = int((row["y"] - grid.min_y) // grid.cell_m)
    best = -1
    best_rank = math.inf
    best_s = 0.0
    best_d = 0.0
    best_beyond = 0.0
    if _is_within(grid, column, line):
        cos_heading, sin_heading = cos_sin(row["heading"])
        cell = line * grid.num_x + column
        for k in range(grid.cell_start[cell], grid.cell_start[cell + 1]):
            lane = grid.cell_lanes[k]
            here = roads.lanes[lane]
            first = here["first_point"]
            s, d, cos, sin = project(roads.points, first, here["num_points"], row["x"], row["y"])
            beyond = max(s - here["length_m"], -s, 0.0)
            s = min(max(s, 0.0), here["length_m"])
            _, _, z, _, _, _ = lane_pose(roads.points, first, here["num_points"], s)
            if abs(z - row["z"]) > LEVEL_M:  # false for NaN
                continue
            half = 0.5 * here["width_m"]
            along = cos * cos_heading + sin * sin_heading
            rank = max(abs(d), beyond) + ASKEW_M * (1.0 - along)
            if along < 0.0:
                rank += OPPOSITE_M
            if abs(d) > half or beyond > 0.0:
                rank += BESIDE_M
            if abs(d) > half + 0.5 * row["width"] or beyond > 0.5 * row["length"]:
                rank += UNTOUCHED_M
            if rank < best_rank:
                best = lane
                best_rank = rank
                best_s = s
                best_d = d
                best_beyond = beyond
    if best >= 0:
        row["lane"] = best
        row["s"] = best_s
    row["target_lane"] = row["lane"]
    if best_rank >= UNTOUCHED_M:
        row["d"] = math.copysign(max(abs(best_d), best_beyond, OFF_M), best_d)
        row["link"] = -1
        row["side_lane"] = -1
        return False
    row["d"] = best_d
    here = roads.lanes[best]
    if here["internal"]:
        row["link"] = here["link"]
    elif row["link"] >= 0 and roads.links[row["link"]]["to_lane"] != best:
        row["link"] = -1
    row["side_lane"] = side_lane(roads, row)
    return True


@kernel
def _stand(roads: RoadArrays, grid: LaneGrid, row: np.void, z: float, pitch: float) -> None:
    """Set the position on the lanes, and height and pitch if they are NaN."""
    is_on_lane = find_place(roads, grid, row)
    lane = roads.lanes[row["lane"]]
    _, _, ground, _, _, slope = lane_pose(
        roads.points, lane["first_point"], lane["num_points"], row["s"]
    )
    if math.isnan(z) and (is_on_lane or math.isnan(row["z"])):
        row["z"] = ground
    if math.isnan(pitch) and is_on_lane:
        row["pitch"] = atan(slope)


@inlined_kernel
def _drive(
    row: np.void, kind: np.void, told: np.void, accel_limit: float, steering_limit: float, dt: float
) -> None:
    """Move a driven row by the bicycle model, as for an agent; braking ends at a standstill."""
    throttle = clamp(told["throttle"], -accel_limit, accel_limit)
    steering = clamp(told["steering"], -steering_limit, steering_limit)
    throttle = clamp(throttle, -kind["most_decel"], kind["most_accel"])
    steering = clamp(steering, -kind["most_steering"], kind["most_steering"])
    throttle = max(throttle, -max(row["speed"], 0.0) / dt)
    x, y, heading, speed, _ = bicycle_step(
        row["x"], row["y"], row["heading"], row["speed"], throttle, steering, kind["wheelbase"], dt
    )
    most = min(MAX_SPEED_MPS, kind["max_speed"])
    row["x"] = x
    row["y"] = y
    row["heading"] = wrap_angle(heading)
    row["speed"] = clamp(speed, -most, most)
    row["throttle"] = throttle
    row["steering"] = steering


@inlined_kernel
def _approach(row: np.void, told: np.void, ticks_left: int, dt: float) -> None:
    """Move a posed row by this tick's share of the distance to its pose."""
    share = 1.0 / ticks_left
    x = row["x"]
    y = row["y"]
    speed = row["speed"]
    if ticks_left == 1:
        row["x"] = told["x"]
        row["y"] = told["y"]
        row["heading"] = wrap_angle(told["heading"])
    else:
        row["x"] += (told["x"] - x) * share
        row["y"] += (told["y"] - y) * share
        turn = wrap_angle(told["heading"] - row["heading"])
        row["heading"] = wrap_angle(row["heading"] + turn * share)
    if not math.isnan(told["z"]):
        row["z"] += (told["z"] - row["z"]) * share
    if not math.isnan(told["pitch"]):
        row["pitch"] += (told["pitch"] - row["pitch"]) * share
    cos, sin = cos_sin(row["heading"])
    row["speed"] = ((row["x"] - x) * cos + (row["y"] - y) * sin) / dt
    if not math.isnan(told["speed"]):
        row["speed"] = told["speed"]
    row["throttle"] = (row["speed"] - speed) / dt
    row["steering"] = 0.0


@inlined_kernel
def _is_far(row: np.void, told: np.void, reach_m: float) -> bool:
    dx = told["x"] - row["x"]
    dy = told["y"] - row["y"]
    far: bool = dx * dx + dy * dy > reach_m * reach_m
    return far


@kernel
def move_external(
    roads: RoadArrays,
    travel: TripTables,
    grid: LaneGrid,
    held: NDArray[np.void],  # EXTERNAL (W, E), the present commands
    leaving: NDArray[np.bool_],  # (W, E) slots whose vehicles leave in this tick
    first: int,  # only the rows of the slots [first, end) move
    end: int,
    zoned: ZoneState,  # the owned rows of `side` are written
    side: int,
    ticks: NDArray[np.int64],  # (W,)
    ticks_per_step: int,
    reach_m: float,  # a row farther from its pose than this leaves, and enters again at the pose
    accel_limit: float,  # limit of the throttle, m/s²
    steering_limit: float,  # limit of the front wheels, rad
    dt: float,
) -> int:
    """Move external rows of all zones for one tick, and mark leaving rows as arrived.

    Returns the number of rows that leave.
    """
    gone = 0
    for zone in range(zoned.num_owned.shape[0]):
        for w in range(zoned.num_owned.shape[1]):
            ticks_left = ticks_per_step - ticks[w] % ticks_per_step
            found = False
            for i in range(zoned.num_owned[zone, w]):
                row = zoned.rows[side, zone, w, i]
                if row["driver"] != DRIVER_EXTERNAL or not first <= row["order"] < end:
                    continue
                found = True
                told = held[w, row["order"]]
                is_driven = told["kind"] == EXTERNAL_DRIVEN
                row["events"] = 0
                if leaving[w, row["order"]] or (not is_driven and _is_far(row, told, reach_m)):
                    row["events"] = EVENT_ARRIVED
                    row["tick"] += 1
                    gone += 1
                    continue
                before = before_tick(row)
                kind = travel.types[row["vtype"]]
                if is_driven:
                    _drive(row, kind, told, accel_limit, steering_limit, dt)
                    _stand(roads, grid, row, math.nan, math.nan)
                else:
                    _approach(row, told, ticks_left, dt)
                    _stand(roads, grid, row, told["z"], told["pitch"])
                account(row, before, free_speed(roads.lanes[before.lane], kind, 1.0), dt)
            if found:
                zoned.num_outer[zone, w] = -1
    return gone


@kernel
def enter_at(roads: RoadArrays, grid: LaneGrid, told: np.void, row: np.void) -> None:
    """Copy the body and the pose of an EXTERNAL to a new row."""
    row["vtype"] = int(told["vtype"])
    row["length"] = told["length"]
    row["width"] = told["width"]
    row["height"] = told["height"]
    row["x"] = told["x"]
    row["y"] = told["y"]
    row["z"] = told["z"]
    row["heading"] = wrap_angle(told["heading"])
    if not math.isnan(told["pitch"]):
        row["pitch"] = told["pitch"]
    if not math.isnan(told["speed"]):
        row["speed"] = told["speed"]
    _stand(roads, grid, row, told["z"], told["pitch"])


@kernel
def write_external(
    roads: RoadArrays,
    grid: LaneGrid,
    told: np.void,  # EXTERNAL
    vehicle: int,  # id of the vehicle
    slot: int,
    nowhere: int,  # VEHICLE["way"] of a vehicle without a route
    key: np.uint64,  # random key of the world
    tick: int,
    row: np.void,  # VEHICLE, blank; written
) -> None:
    """Write the row of a vehicle that enters."""
    row["id"] = vehicle
    row["driver"] = DRIVER_EXTERNAL
    row["order"] = slot
    enter_at(roads, grid, told, row)
    row["goal"] = -1
    row["way"] = nowhere
    row["to_go"] = math.inf
    row["step_to_go"] = math.inf
    row["rng_key"] = key
    row["departed"] = tick
    row["tick"] = tick


@kernel
def add_external(
    roads: RoadArrays,
    grid: LaneGrid,
    held: NDArray[np.void],  # EXTERNAL (W, E), the present commands
    coming: NDArray[np.bool_],  # (W, E) slots whose vehicles enter in this tick
    ids: NDArray[np.int64],  # (W, E), written
    blank: NDArray[np.void],  # VEHICLE (1,), template of every vehicle's record
    nowhere: int,  # VEHICLE["way"] of a vehicle without a route
    departures: DepartureQueue,  # passing is written
    ticks: NDArray[np.int64],  # (W,)
    keys: NDArray[np.uint64],  # (W,)
) -> None:
    """Add a row with a new id to `departures.passing` for each vehicle that enters.

    A slot gets at most one vehicle per tick, so tick and slot determine a new id.
    """
    for w in range(coming.shape[0]):
        for slot in range(coming.shape[1]):
            if not coming[w, slot]:
                continue
            place = departures.num_passing[w]
            departures.passing[w, place] = blank[0]
            departures.num_passing[w] = place + 1
            row = departures.passing[w, place]
            vehicle = FIRST_EXTERNAL_ID + ticks[w] * coming.shape[1] + slot
            ids[w, slot] = vehicle
            told = held[w, slot]
            write_external(roads, grid, told, vehicle, slot, nowhere, keys[w], ticks[w], row)
