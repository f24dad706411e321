"""Conversion of actions to throttle and steering: meta-actions and their controllers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import asin, atan2, cosine, sine, tangent
from cavmarl.core.math.geometry import lane_pose, project, wrap_angle
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.core.records.codes import (
    ACTION_FASTER,
    ACTION_LANE_LEFT,
    ACTION_LANE_RIGHT,
    ACTION_SLOWER,
)
from cavmarl.driving.kernels.motion.highway_control import (
    MAX_STEERING_RAD,
    PURSUIT_S,
    steering_control,
)

# In a bend, a driver aims at a point of the path that is `AIM_M` or `AIM_S` ahead, whichever is
# further. A lane is a bend if that point deviates by `AIM_RAD` from the direction of the lane.
AIM_M = 4.0
AIM_S = 0.6
AIM_RAD = 0.1
MAX_AIM_LANES = 8  # largest number of lanes up to that point
# In turns at junctions, the aim distance is `TURN_AIM_M`, plus `AIM_EARLIER` times the distance by
# which an arc of the turning circle starts before the arc of the path. It is limited to
# `AIM_M_PER_RAD` times the angle of the turn, and to `MOST_AIM_M`.
TURN_AIM_M = 3.0
AIM_EARLIER = 1.5
AIM_M_PER_RAD = 2.6
MOST_AIM_M = 7.0
MOST_TURN_RAD = 2.8  # upper bound of the angle of a turn
CUT_RADIUS_M = 6.0  # up to this radius of a turn, a car cuts the corner most
WIDE_RADIUS_M = 9.0  # from this radius of a turn on, a car follows the path exactly
NEAR_TURN_M = 10.0  # distance to a junction at which its turn counts
TURN_MPS = 3.5  # in and after junctions, slower cars steer as if at this speed
TURNING_RATIO = 1.118  # turning circle radius divided by the wheelbase, wheels turned by 45°
SLOW_MPS = 3.0  # a slower car may stop at an angle during a lane change
SWING_OUT_M = 0.1  # the front of such a car reaches at most this far beyond the lane's far side
CHORD_M = 1.5  # lanes have corners, so their direction is taken from a chord of twice this length


@kernel
def nearest_speed(target_speeds: NDArray[np.float64], speed: float) -> int:
    """Return the index of the target speed nearest to `speed`; on a tie, of the lower speed."""
    best = 0
    for k in range(1, target_speeds.shape[0]):
        if abs(target_speeds[k] - speed) < abs(target_speeds[best] - speed):
            best = k
    return best


@kernel
def take_meta_action(
    roads: RoadArrays, row: np.void, action: int, target_speeds: NDArray[np.float64]
) -> None:
    """Set target lane and target speed of a vehicle as highway-env's `MDPVehicle` does.

    FASTER and SLOWER select the next higher or lower target speed. A lane change selects the
    neighbour of the present lane, and has no effect if there is no neighbour.
    """
    k = nearest_speed(target_speeds, row["target_speed"])
    if action == ACTION_FASTER:
        k = min(k + 1, target_speeds.shape[0] - 1)
    elif action == ACTION_SLOWER:
        k = max(k - 1, 0)
    elif action == ACTION_LANE_LEFT and roads.lanes[row["lane"]]["left"] >= 0:
        row["target_lane"] = roads.lanes[row["lane"]]["left"]
    elif action == ACTION_LANE_RIGHT and roads.lanes[row["lane"]]["right"] >= 0:
        row["target_lane"] = roads.lanes[row["lane"]]["right"]
    row["target_speed"] = target_speeds[k]


@kernel
def steer_to_lane(
    roads: RoadArrays, plans: NDArray[np.void], row: np.void, target_lane: int, wheelbase: float
) -> float:
    """Return the steering angle in rad that moves a vehicle to the middle of a lane.

    If `target_lane` is neither the vehicle's lane nor a neighbour lane, the vehicle's lane is used.
    Beyond the end of the lane, the next lane of the plan is used. `wheelbase` is in m.
    """
    lane = row["lane"]
    here = roads.lanes[lane]
    if target_lane >= 0 and (target_lane == here["left"] or target_lane == here["right"]):
        lane = target_lane
        here = roads.lanes[lane]
    s, d, _, _ = project(roads.points, here["first_point"], here["num_points"], row["x"], row["y"])
    ahead = s + row["speed"] * PURSUIT_S
    following = plans[row["goal"], lane]["next"]
    if s > here["length_m"] and following >= 0:
        ahead -= here["length_m"]
        lane = following
        here = roads.lanes[lane]
        s, d, _, _ = project(
            roads.points, here["first_point"], here["num_points"], row["x"], row["y"]
        )
    aimed = _aim(roads, plans, row, lane, s, wheelbase)
    if aimed < math.inf:
        return aimed
    direction = _direction_at(roads, plans, row["goal"], lane, ahead)
    turned = wrap_angle(direction - row["heading"])
    if row["speed"] < SLOW_MPS and d * turned > 0.0 and not here["internal"]:
        room = 0.5 * here["width_m"] + SWING_OUT_M - 0.5 * row["width"] + abs(d)
        most = asin(clamp(2.0 * room / row["length"], 0.0, 1.0))
        if abs(turned) > most:
            d, turned = 0.0, math.copysign(abs(turned) - most, turned)
    pace = row["speed"]
    if 0.0 <= pace < TURN_MPS and (here["internal"] or s < NEAR_TURN_M):
        pace = TURN_MPS
    return steering_control(pace, d, turned, wheelbase)


@kernel
def _aim_m(
    roads: RoadArrays, plans: NDArray[np.void], row: np.void, lane: int, s: float, wheelbase: float
) -> tuple[float, float]:
    """Return the aim distance in m in a bend, and how exactly the car follows the path (0 to 1).

    In sharper turns, the aim distance is larger and the car cuts the corner at the kerb more, so
    that its front does not swing over the middle of the road.
    """
    here = roads.lanes[lane]
    link = here["link"]
    if not here["internal"]:
        if s < here["length_m"] - NEAR_TURN_M:
            return AIM_M, 1.0
        link = plans[row["goal"], lane]["link"]
    if link < 0 or roads.links[link]["length_m"] == 0.0:
        return AIM_M, 1.0
    turned = roads.links[link]
    before = roads.lanes[turned["from_lane"]]
    last = roads.points[before["first_point"] + before["num_points"] - 1]
    first = roads.points[roads.lanes[turned["to_lane"]]["first_point"]]
    turn = abs(wrap_angle(first["heading"] - last["heading"]))
    if turn < AIM_RAD:
        return AIM_M, 1.0
    radius_m = turned["length_m"] / turn
    missing_m = max(TURNING_RATIO * wheelbase - radius_m, 0.0)
    earlier_m = missing_m * tangent(0.5 * min(turn, MOST_TURN_RAD))
    most_m = min(AIM_M_PER_RAD * turn, MOST_AIM_M)
    aim_m = max(min(TURN_AIM_M + AIM_EARLIER * earlier_m, most_m), TURN_AIM_M)
    return aim_m, clamp((radius_m - CUT_RADIUS_M) / (WIDE_RADIUS_M - CUT_RADIUS_M), 0.0, 1.0)


@kernel
def _aim(
    roads: RoadArrays, plans: NDArray[np.void], row: np.void, lane: int, s: float, wheelbase: float
) -> float:
    """Return the steering angle in rad for a bend, or inf if there is no bend.

    Pure pursuit: the car drives on an arc through a point of the path ahead. So it turns early
    before a bend that is sharper than its turning circle. Coulter: "Implementation of the pure
    pursuit path tracking algorithm", CMU-RI-TR-92-01.
    """
    here = roads.lanes[lane]
    x0, y0, _, cos, sin, _ = lane_pose(roads.points, here["first_point"], here["num_points"], s)
    aim_m, exact = _aim_m(roads, plans, row, lane, s, wheelbase)
    aim_m = max(aim_m, AIM_S * row["speed"])
    x, y = _point_at(roads, plans, row["goal"], lane, s + aim_m)
    aside = atan2(cos * (y - y0) - sin * (x - x0), cos * (x - x0) + sin * (y - y0))
    if abs(aside) < AIM_RAD:
        return math.inf
    x -= row["x"]
    y -= row["y"]
    apart = math.sqrt(x * x + y * y)
    bearing = wrap_angle(atan2(y, x) - row["heading"])
    if abs(bearing) > 0.5 * math.pi:
        return math.copysign(MAX_STEERING_RAD, bearing)
    # `following` is the arc of the rear axle, whose direction is the car's heading. `cutting` is
    # the arc of the centre, as if the centre moved in the direction of the heading.
    apart = max(apart, TURN_AIM_M)
    aside_m = wheelbase * sine(abs(bearing))
    following = atan2(2.0 * aside_m, apart + wheelbase * cosine(bearing))
    sin_slip = min(aside_m / apart, 1.0)
    cutting = atan2(2.0 * sin_slip, math.sqrt(1.0 - sin_slip * sin_slip))
    steering = exact * following + (1.0 - exact) * cutting
    return math.copysign(min(steering, MAX_STEERING_RAD), bearing)


@kernel
def _point_at(
    roads: RoadArrays, plans: NDArray[np.void], goal: int, lane: int, s: float
) -> tuple[float, float]:
    """Return the point at `s` of a lane; beyond the lane's end, follow the lanes of the plan."""
    here = roads.lanes[lane]
    for _ in range(MAX_AIM_LANES):
        following = plans[goal, lane]["next"]
        if s <= here["length_m"] or following < 0:
            break
        s -= here["length_m"]
        lane = following
        here = roads.lanes[lane]
    x, y, _, _, _, _ = lane_pose(roads.points, here["first_point"], here["num_points"], s)
    return x, y


@kernel
def _direction_at(
    roads: RoadArrays, plans: NDArray[np.void], goal: int, lane: int, s: float
) -> float:
    """Return the direction in rad of the path around `s` of a lane."""
    x0, y0 = _point_at(roads, plans, goal, lane, s - CHORD_M)
    x1, y1 = _point_at(roads, plans, goal, lane, s + CHORD_M)
    return atan2(y1 - y0, x1 - x0)
