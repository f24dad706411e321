"""The path of a steered car over a junction, with the steering of the built-in driver."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cosine, sine
from cavmarl.core.math.geometry import lane_pose
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import LaneGrid, RoadArrays
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from cavmarl.driving.kernels.motion.speed_limits_ahead import bend_speed
from cavmarl.driving.kernels.motion.steering import steer_to_lane
from cavmarl.driving.kernels.motion.tracking import locate

ACCEL = 1.5  # m/s², acceleration out of a bend
MOST_MPS = 10.0  # top speed, so that the poses of successive ticks are close to one another
LEAST_MPS = 1.0
LANES_AHEAD = 4  # number of lanes ahead whose bends limit the speed


@kernel
def _allowed_mps(roads: RoadArrays, plan: NDArray[np.void], row: np.void) -> float:
    """Return the speed in m/s that the bends ahead allow."""
    lane = row["lane"]
    allowed = min(MOST_MPS, bend_speed(roads, lane, lane, -row["s"]))
    distance = roads.lanes[lane]["length_m"] - row["s"]
    for _ in range(LANES_AHEAD):
        following = plan[0, lane]["next"]
        if following < 0:
            break
        allowed = min(allowed, bend_speed(roads, lane, following, distance))
        distance += roads.lanes[following]["length_m"]
        lane = following
    return max(allowed, LEAST_MPS)


@kernel
def steered_poses(
    roads: RoadArrays,
    plan: NDArray[np.void],  # PLAN (1, L) with the next lanes of the path, and the link
    grid: LaneGrid,
    row: np.void,  # VEHICLE, blank except for its size; overwritten
    wheelbase: float,  # m
    steering_rad: float,  # largest steering angle
    link: int,  # LINK that the car takes
    begin_m: float,  # distance of the start before the stop line
    end_m: float,  # distance of the end after the junction
    dt: float,  # s
    # (m, 6) distance from the stop line, x, y, z, cosine and sine of the heading; overwritten
    poses: NDArray[np.float64],
) -> int:
    """Drive a car over a link, write its poses, and return their number.

    The drive ends early if the car leaves its path.
    """
    way = roads.links[link]
    lane = way["from_lane"]
    here = roads.lanes[lane]
    s = max(here["length_m"] - begin_m, 0.0)
    x, y, z, cos, sin, _ = lane_pose(roads.points, here["first_point"], here["num_points"], s)
    row["x"], row["y"], row["z"] = x, y, z
    row["heading"] = atan2(sin, cos)
    row["lane"], row["s"], row["d"] = lane, s, 0.0
    row["speed"] = _allowed_mps(roads, plan, row)
    found = 0
    while found < poses.shape[0]:
        lane = row["lane"]
        place = row["s"] - roads.lanes[lane]["length_m"]
        if lane == way["to_lane"]:
            place = way["length_m"] + row["s"]
        elif roads.lanes[lane]["internal"] and roads.lanes[lane]["link"] == link:
            place = roads.lanes[lane]["link_offset_m"] + row["s"]
        elif lane != way["from_lane"]:
            break
        if place > way["length_m"] + end_m:
            break
        pose = poses[found]
        pose[0], pose[1], pose[2], pose[3] = place, row["x"], row["y"], z
        pose[4], pose[5] = cosine(row["heading"]), sine(row["heading"])
        found += 1
        if lane == way["to_lane"] and row["s"] >= roads.lanes[lane]["length_m"]:
            break
        row["speed"] = min(row["speed"] + ACCEL * dt, _allowed_mps(roads, plan, row))
        steering = steer_to_lane(roads, plan, row, lane, wheelbase)
        row["x"], row["y"], row["heading"], _, _ = bicycle_step(
            row["x"],
            row["y"],
            row["heading"],
            row["speed"],
            0.0,
            clamp(steering, -steering_rad, steering_rad),
            wheelbase,
            dt,
        )
        if locate(roads, plan, grid, row) != 0:
            break
        here = roads.lanes[row["lane"]]
        _, _, z, _, _, _ = lane_pose(
            roads.points, here["first_point"], here["num_points"], row["s"]
        )
    return found
