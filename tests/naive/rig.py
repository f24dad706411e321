"""Compute samples of mounted sensors from their definitions."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

Matrix = NDArray[np.float64]
GRAVITY = np.array([0.0, 0.0, 9.80665])


def sample_ticks(rate: Fraction, phase: int, last_tick: int) -> list[int]:
    """Return the tick that delivers each sample."""
    ticks = []
    number = 0
    while (tick := phase + math.ceil(number / rate)) <= last_tick:
        ticks.append(tick)
        number += 1
    return ticks


def turn(yaw: float, pitch: float, roll: float) -> Matrix:
    """Return a rotation: yaw about z, then pitch upwards (about -y), then roll about x."""
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    matrix: Matrix = about_z @ about_y @ about_x
    return matrix


def mount_turn(config: Any) -> Matrix:
    return turn(*np.radians([config.yaw_deg, config.pitch_deg, config.roll_deg]).tolist())


def place_in_world(row: np.void, config: Any) -> Matrix:
    """Return the position of a mounted sensor in the world."""
    body = turn(float(row["heading"]), float(row["pitch"]), 0.0)
    at = np.array([config.x_m, config.y_m, config.z_m])
    place: Matrix = np.array([row["x"], row["y"], row["z"]]) + body @ at
    return place


def between(before: np.void | None, after: np.void, name: str, share: float) -> float:
    """Interpolate a quantity within a tick."""
    if before is None:
        return float(after[name])
    return float((1.0 - share) * before[name] + share * after[name])


def odometry(before: np.void | None, after: np.void, share: float) -> Matrix:
    return np.array(
        [between(before, after, name, share) for name in ("speed", "yaw_rate", "distance_m")]
    )


def inertia(
    before: np.void | None, after: np.void, share: float, tick_s: float, config: Any
) -> Matrix:
    """Return specific force and angular rate along the axes of the sensor, by vector algebra."""
    v, a, r, steering, pitch = (
        between(before, after, name, share)
        for name in ("speed", "accel", "yaw_rate", "steering", "pitch")
    )
    slip = math.atan(0.5 * math.tan(steering))
    along = np.array([math.cos(slip), math.sin(slip), 0.0])
    yaw = np.array([0.0, 0.0, r])
    at = np.array([config.x_m, config.y_m, 0.0])
    change = 0.0 if before is None else float(after["yaw_rate"] - before["yaw_rate"]) / tick_s
    climb = 0.0 if before is None else float(after["pitch"] - before["pitch"]) / tick_s
    force = a * along + np.cross(yaw, v * along)
    force += np.cross([0.0, 0.0, change], at) + np.cross(yaw, np.cross(yaw, at))
    tilt = turn(0.0, pitch, 0.0)
    rate = tilt.T @ yaw + np.array([0.0, -climb, 0.0])
    sensor = mount_turn(config)
    return np.concatenate([sensor.T @ (force + tilt.T @ GRAVITY), sensor.T @ rate])


def lane_boundary(roads: RoadNetwork, plans: NDArray[np.void], row: np.void, config: Any) -> Matrix:
    """Return distances to the left and right boundary, width, direction and curvature of a lane."""
    points = roads.lane_polyline(int(row["lane"]))[:, :2]
    x, y, _ = place_in_world(row, config)
    best: tuple[float, float, float] | None = None
    for (x0, y0), (x1, y1) in pairwise(points):
        length = math.hypot(x1 - x0, y1 - y0)
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        t = (x - x0) * ux + (y - y0) * uy
        away = math.hypot(
            x - x0 - min(max(t, 0), length) * ux, y - y0 - min(max(t, 0), length) * uy
        )
        left = (y - y0) * ux - (x - x0) * uy
        if best is None or away < best[0] - 1e-12:
            best = (away, left, math.atan2(uy, ux))
    assert best is not None
    width = float(roads.lanes[row["lane"]]["width_m"])
    forward = turn(float(row["heading"]), float(row["pitch"]), 0.0) @ mount_turn(config)[:, 0]
    error = math.atan2(forward[1], forward[0]) - best[2]
    error = math.atan2(math.sin(error), math.cos(error))
    three = [_ahead(roads, plans, row, share * config.lookahead_m) for share in (0.0, 0.5, 1.0)]
    return np.array([0.5 * width - best[1], 0.5 * width + best[1], width, error, _circle(*three)])


def _ahead(roads: RoadNetwork, plans: NDArray[np.void], row: np.void, ahead: float) -> Matrix:
    """Return a point on the path ahead, by going along the points of the path."""
    lane, rest = int(row["lane"]), float(row["s"]) + ahead
    while True:
        points = roads.lane_polyline(lane)[:, :2]
        for one, other in pairwise(points):
            length = float(np.hypot(*(other - one)))
            if rest <= length:
                place: Matrix = one + (other - one) * rest / length
                return place
            rest -= length
        following = int(plans[row["goal"], lane]["next"])
        if following < 0:
            last: Matrix = points[-1]
            return last
        lane = following


def _circle(one: Matrix, two: Matrix, three: Matrix) -> float:
    """Return the curvature of the circle through three points, positive to the left."""
    a, b, c = (float(np.hypot(*d)) for d in (two - one, three - two, three - one))
    if min(a, b, c) == 0.0:
        return 0.0
    area = 0.5 * float((two - one)[0] * (three - one)[1] - (two - one)[1] * (three - one)[0])
    return 4.0 * area / (a * b * c)
