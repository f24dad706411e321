"""Motion of one vehicle over one tick, in place in its record.

Background vehicles move along their lanes: the decided acceleration changes `s`, `d` moves towards
the lane's centre, and the body is a chord of the path. Agents' vehicles are kinematic bicycles;
`tracking.locate` then finds their place on the lanes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.elementary import atan, atan2
from cavmarl.core.math.geometry import lane_pose, segment_at, wrap_angle
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import LaneGrid, RoadArrays, TripTables
from cavmarl.core.records.codes import EVENT_ARRIVED, EVENT_RED_LIGHT, SIGNAL_RED, SIGNAL_RED_YELLOW
from cavmarl.driving.kernels.junctions.gaps import link_signal
from cavmarl.driving.kernels.lanes.lane_index import beside_s
from cavmarl.driving.kernels.lanes.route_following import (
    distance_left,
    free_speed,
    next_step,
    own_step,
)
from cavmarl.driving.kernels.lanes.side_clearance import STAYS_ASIDE
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from cavmarl.driving.kernels.motion.ordered_stops import advance_stop
from cavmarl.driving.kernels.motion.tracking import locate, side_lane

LATERAL_MPS = 1.4  # largest lateral speed of a lane change
LATERAL_RATIO = 0.35  # largest lateral speed as a share of the speed
LATERAL_MIN_MPS = 0.5  # lower bound of that limit, so that no vehicle is stuck between two lanes
MAX_DRIFT_RAD = 0.12  # largest angle between a vehicle and its lane during a lane change
MAX_SWING_M = 0.3  # largest distance by which the vehicle's corners then swing out
MAX_BODY_LANES = 8  # lanes that a body can cover, in each direction from its centre
STANDING_MPS = 0.1
# A trip ends when the front of a background vehicle, or the centre of an agent's vehicle, is this
# far before the end of the goal edge.
ARRIVE_M = 5.0
MAX_SPEED_MPS = 60.0
CROSSINGS_PER_TICK = 16  # largest number of lane ends passed in one tick


class Before(NamedTuple):
    """Values of the record before the tick, which motion needs after it has overwritten them."""

    speed: float  # m/s
    accel: float  # m/s²
    heading: float  # rad
    lane: int
    link: int
    way: int


@inlined_kernel
def before_tick(row: np.void) -> Before:
    """Copy these values from a record before it moves."""
    return Before(row["speed"], row["accel"], row["heading"], row["lane"], row["link"], row["way"])


@kernel
def _way_point(
    roads: RoadArrays, travel: TripTables, row: np.void, s: float
) -> tuple[float, float]:
    """Return x and y of the point of a vehicle's path that is `s` m from the start of its lane."""
    lane = row["lane"]
    way = row["way"]
    for _ in range(MAX_BODY_LANES):
        length = roads.lanes[lane]["length_m"]
        if s <= length:
            break
        following, way, _ = next_step(roads, travel, lane, way)
        if following < 0:
            break
        s -= length
        lane = following
    for _ in range(MAX_BODY_LANES):
        if s >= 0.0:
            break
        before = lane_before(roads, lane, row["link"])
        if before < 0:
            break
        lane = before
        s += roads.lanes[lane]["length_m"]
    here = roads.lanes[lane]
    x, y, _, _, _, _ = lane_pose(roads.points, here["first_point"], here["num_points"], s)
    return x, y


@kernel
def lane_before(roads: RoadArrays, lane: int, link: int) -> int:
    """Return the lane before `lane` for a vehicle that last entered `link`, or -1."""
    here = roads.lanes[lane]
    if here["internal"]:
        return int(roads.into[here["first_into"]])
    if link < 0 or roads.links[link]["to_lane"] != lane or roads.links[link]["first_internal"] < 0:
        return -1
    before = roads.links[link]["first_internal"]
    while roads.lanes[before]["successor"] != lane:
        before = roads.lanes[before]["successor"]
    return int(before)


@inlined_kernel
def place_on_lane(roads: RoadArrays, travel: TripTables, row: np.void) -> float:
    """Set x, y, z and pitch from lane, s and d, and return the direction of the body in rad.

    Both bumpers are on the path: in a bend, the body is a chord.
    """
    lane = roads.lanes[row["lane"]]
    point = roads.points[
        segment_at(roads.points, lane["first_point"], lane["num_points"], row["s"])
    ]
    along = row["s"] - point["s"]
    cos = point["cos"]
    sin = point["sin"]
    x = point["x"] + along * cos
    y = point["y"] + along * sin
    heading = point["heading"]
    half = 0.5 * row["length"]
    if lane["num_points"] > 2 or row["s"] < half or row["s"] + half > lane["length_m"]:
        front_x, front_y = _way_point(roads, travel, row, row["s"] + half)
        rear_x, rear_y = _way_point(roads, travel, row, row["s"] - half)
        along_x = front_x - rear_x
        along_y = front_y - rear_y
        chord = math.sqrt(along_x * along_x + along_y * along_y)
        if chord > 0.5 * half:
            x = 0.5 * (front_x + rear_x)
            y = 0.5 * (front_y + rear_y)
            cos = along_x / chord
            sin = along_y / chord
            heading = atan2(sin, cos)
    row["x"] = x - row["d"] * sin
    row["y"] = y + row["d"] * cos
    row["z"] = point["z"] + along * point["slope"]
    row["pitch"] = atan(point["slope"]) if point["slope"] != 0.0 else 0.0
    return float(heading)


@inlined_kernel
def account(row: np.void, before: Before, free_mps: float, dt: float) -> None:
    """Update the rates, distances and waiting time of a record after any kind of motion.

    `free_mps`: the vehicle's `free_speed` on its lane before the tick.
    """
    row["accel"] = (row["speed"] - before.speed) / dt
    row["jerk"] = (row["accel"] - before.accel) / dt
    row["yaw_rate"] = wrap_angle(row["heading"] - before.heading) / dt
    driven = abs(before.speed) * dt
    row["distance_m"] += driven
    row["free_s"] += driven / free_mps
    row["wait_s"] = row["wait_s"] + dt if abs(row["speed"]) < STANDING_MPS else 0.0
    row["step_jerk"] += abs(row["jerk"]) * dt
    row["tick"] += 1


@kernel
def _cross_borders(roads: RoadArrays, travel: TripTables, row: np.void) -> bool:
    """Move a row whose s is beyond its lane's end to the next lanes; return False at route end."""
    for _ in range(CROSSINGS_PER_TICK):
        length = roads.lanes[row["lane"]]["length_m"]
        if row["s"] < length:
            return True
        lane, way, link = next_step(roads, travel, row["lane"], row["way"])
        if lane < 0:
            row["s"] = length
            return False
        row["s"] -= length
        row["lane"] = lane
        row["way"] = way
        row["target_lane"] = lane
        if link >= 0:
            row["link"] = link
            row["stopped_at"] = -1
    return True


@inlined_kernel
def _stand(row: np.void, throttle: float, dt: float) -> None:
    """Update the record of a stopped background vehicle."""
    row["throttle"] = throttle
    row["jerk"] = -row["accel"] / dt
    row["accel"] = 0.0
    row["yaw_rate"] = 0.0
    row["steering"] = 0.0
    row["wait_s"] += dt
    row["step_jerk"] += abs(row["jerk"]) * dt
    row["tick"] += 1


@inlined_kernel
def move_background(
    roads: RoadArrays,
    travel: TripTables,
    row: np.void,  # VEHICLE before the tick; overwritten with the state after it
    step: np.void,  # PLAN of the vehicle's lane before the tick
    accel: float,  # decided acceleration, m/s²
    lane_change: int,  # 1 left, -1 right, 0 none; STAYS_ASIDE: wait between two lanes
    dt: float,  # length of the tick, s
) -> None:
    """Advance a background vehicle by one tick.

    The new speed applies to the whole tick (semi-implicit Euler), as the safe speed of Krauss's
    model assumes.
    """
    before = before_tick(row)
    speed = clamp(before.speed + accel * dt, 0.0, MAX_SPEED_MPS)
    if speed == 0.0 and before.speed == 0.0 and lane_change == 0 and row["d"] == 0.0:
        _stand(row, accel, dt)
        advance_stop(roads, travel, row, before.lane, dt)
        return
    row["throttle"] = accel
    row["speed"] = speed
    row["s"] += speed * dt
    if abs(lane_change) == 1:
        lane = roads.lanes[before.lane]
        target = lane["left"] if lane_change > 0 else lane["right"]
        row["s"] = beside_s(roads, before.lane, target, row["s"])
        apart = 0.5 * (lane["width_m"] + roads.lanes[target]["width_m"])
        row["d"] -= lane_change * apart
        row["lane"] = target
        row["target_lane"] = target
        row["last_change"] = row["tick"]
    if not _cross_borders(roads, travel, row):
        row["speed"] = 0.0
    sideways = min(LATERAL_MPS, max(LATERAL_RATIO * speed, LATERAL_MIN_MPS)) * dt
    if lane_change == STAYS_ASIDE:
        sideways = 0.0
    offset = row["d"]
    row["d"] = offset - clamp(offset, -sideways, sideways)
    row["side_lane"] = side_lane(roads, row)
    heading = place_on_lane(roads, travel, row)
    if row["d"] != offset and speed > STANDING_MPS:
        drift = atan2((row["d"] - offset) / dt, speed)
        most = min(MAX_DRIFT_RAD, 2.0 * MAX_SWING_M / row["length"])
        heading = wrap_angle(heading + clamp(drift, -most, most))
    row["heading"] = heading
    turned = wrap_angle(heading - before.heading)
    row["steering"] = 0.0
    if turned != 0.0 and speed > STANDING_MPS:
        row["steering"] = clamp(atan(row["length"] * turned / (speed * dt)), -0.8, 0.8)
    if row["lane"] == before.lane and row["way"] == before.way:
        row["to_go"] = distance_left(roads, row, step)
    else:
        row["to_go"] = distance_left(roads, row, travel.steps[own_step(roads, row)])
    if row["to_go"] <= ARRIVE_M + 0.5 * row["length"]:
        row["events"] |= EVENT_ARRIVED
    kind = travel.types[row["vtype"]]
    account(row, before, free_speed(roads.lanes[before.lane], kind, row["speed_factor"]), dt)
    advance_stop(roads, travel, row, before.lane, dt)


@kernel
def move_agent(
    roads: RoadArrays,
    plans: NDArray[np.void],  # PLAN (goals, lanes)
    grid: LaneGrid,  # the lanes near each place
    row: np.void,  # VEHICLE before the tick; overwritten with the state after it
    kind: np.void,  # its VTYPE
    throttle: float,  # commanded acceleration, m/s²
    steering: float,  # commanded angle of the front wheels, rad
    phase: NDArray[np.int32],  # (num_signals,) active PHASE rows
    dt: float,  # length of the tick, s
) -> None:
    """Advance an agent's vehicle by one tick."""
    before = before_tick(row)
    throttle = clamp(throttle, -kind["most_decel"], kind["most_accel"])
    steering = clamp(steering, -kind["most_steering"], kind["most_steering"])
    # There is no reverse gear: braking ends at a standstill.
    throttle = max(throttle, -before.speed / dt)
    x, y, heading, speed, _ = bicycle_step(
        row["x"], row["y"], before.heading, before.speed, throttle, steering, kind["wheelbase"], dt
    )
    row["x"] = x
    row["y"] = y
    row["heading"] = wrap_angle(heading)
    row["speed"] = clamp(speed, 0.0, min(MAX_SPEED_MPS, kind["max_speed"]))
    row["throttle"] = throttle
    row["steering"] = steering
    row["events"] |= locate(roads, plans, grid, row)
    if row["link"] != before.link and row["link"] >= 0:
        signal = link_signal(roads, row["link"], phase)
        if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
            row["events"] |= EVENT_RED_LIGHT
    row["side_lane"] = side_lane(roads, row)
    lane = roads.lanes[row["lane"]]
    _, _, z, _, _, slope = lane_pose(
        roads.points, lane["first_point"], lane["num_points"], row["s"]
    )
    row["z"] = z
    row["pitch"] = atan(slope)
    step = plans[row["goal"], row["lane"]]
    row["to_go"] = step["to_go"] - row["s"]
    if row["to_go"] <= ARRIVE_M:
        row["events"] |= EVENT_ARRIVED
    account(row, before, free_speed(roads.lanes[before.lane], kind, 1.0), dt)
