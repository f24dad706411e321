"""How a mounted sensor lies in the lane of its vehicle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import lane_pose, project_near, wrap_angle
from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import RoadArrays, Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.sensors.kernels.mount_poses import Mount, sensor_pose
from cavmarl.sensors.kernels.rig_noise import Noise, add_errors
from cavmarl.sensors.kernels.rig_schedule import Due

_WINDOW_M = 15.0  # around the vehicle's place on its lane, where the sensor's is looked for


@kernel
def _way_ahead(
    roads: RoadArrays, plans: NDArray[np.void], row: np.void, ahead: float
) -> tuple[float, float]:
    """X and y of a place on the way of a vehicle, or of the way's end."""
    lane = row["lane"]
    s = row["s"] + ahead
    while s > roads.lanes[lane]["length_m"]:
        following = plans[row["goal"], lane]["next"]
        if following < 0:
            s = roads.lanes[lane]["length_m"]
            break
        s -= roads.lanes[lane]["length_m"]
        lane = following
    here = roads.lanes[lane]
    x, y, _, _, _, _ = lane_pose(roads.points, here["first_point"], here["num_points"], s)
    return x, y


@kernel
def bend(x0: float, y0: float, x1: float, y1: float, x2: float, y2: float) -> float:
    """Curvature of the circle through three points in 1/m, positive to the left; 0 if two are one.

    Four times the triangle's area over the product of its sides.
    """
    ax, ay = x1 - x0, y1 - y0
    bx, by = x2 - x1, y2 - y1
    cx, cy = x2 - x0, y2 - y0
    sides = math.sqrt((ax * ax + ay * ay) * (bx * bx + by * by) * (cx * cx + cy * cy))
    return 2.0 * (ax * by - ay * bx) / sides if sides > 0.0 else 0.0


@kernel
def measure_lane_boundary(
    roads: RoadArrays,
    plans: NDArray[np.void],
    worlds: Worlds,
    mount: Mount,
    lookahead_m: float,
    due: Due,
    noise: Noise,
    axes: NDArray[np.float64],
    room: NDArray[np.float64],
    data: NDArray[np.float32],
) -> None:
    """Write what is due of the owned agents.

    `lookahead_m`: length of the way that the curvature is that of. `axes`: (2, 3, 3), room. `room`:
    (5,), room. `data`: (W, A, S, 5) to the left boundary, to the right one, and the lane's width in
    m; direction of the sensor from that of the lane in rad; curvature in 1/m.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] != DRIVER_AGENT:
                continue
            x, y, _ = sensor_pose(row, mount, axes[0], axes[1])
            lane = roads.lanes[row["lane"]]
            _, offset, cos, sin = project_near(
                roads.points, lane["first_point"], lane["num_points"], x, y, row["s"], _WINDOW_M
            )
            looks = math.atan2(axes[1, 1, 0], axes[1, 0, 0])
            x0, y0 = _way_ahead(roads, plans, row, 0.0)
            x1, y1 = _way_ahead(roads, plans, row, 0.5 * lookahead_m)
            x2, y2 = _way_ahead(roads, plans, row, lookahead_m)
            room[0] = 0.5 * lane["width_m"] - offset
            room[1] = 0.5 * lane["width_m"] + offset
            room[2] = lane["width_m"]
            room[3] = wrap_angle(looks - math.atan2(sin, cos))
            room[4] = bend(x0, y0, x1, y1, x2, y2)
            add_errors(noise, row, worlds.ticks[w], 0, room)
            for channel in range(room.size):
                data[w, row["agent"], due.slot[w], channel] = room[channel]
