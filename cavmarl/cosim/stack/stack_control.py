"""Control: pure pursuit for the steering, limits of the vehicle's type for the acceleration.

Coulter: "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992: the
circle through the vehicle's centre, tangent to its motion, that meets a point of the path ahead has
the curvature 2 sin(alpha) / distance. The kinematic bicycle turns with that curvature at the slip
angle asin(curvature · L / 2), whose tangent is half that of the steering angle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cavmarl.cosim.stack.hd_map import wrap
from cavmarl.cosim.stack.stack_types import Control2D, EgoPose, Mission, Trajectory


class Gains(NamedTuple):
    """How one type of vehicle is controlled."""

    lookahead_s: float  # how far ahead the steering looks, at the present speed
    least_lookahead_m: float  # and at least
    accel_mps2: float  # the most that it accelerates
    brake_mps2: float  # the most that it brakes, positive
    steering_radps: float  # how fast its front wheels are turned


_CAR = Gains(0.5, 3.5, 2.5, 6.0, 1.2)
_HEAVY = Gains(0.7, 6.0, 1.2, 5.0, 0.6)

# By SUMO's class; others drive as cars do.
GAINS = {"passenger": _CAR, "truck": _HEAVY, "bus": _HEAVY}


class PurePursuit:
    """The controller."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s = tick_s
        self._steering = 0.0

    def control(self, pose: EgoPose, trajectory: Trajectory, mission: Mission) -> Control2D:
        gains = GAINS.get(mission.vclass, _CAR)
        slip = math.atan(0.5 * math.tan(self._steering))
        ahead_m = max(gains.least_lookahead_m, gains.lookahead_s * pose.speed_mps)
        x_m, y_m = _point_at(trajectory, pose, ahead_m)
        east, north = x_m - pose.x_m, y_m - pose.y_m
        distance = max(math.hypot(east, north), 0.5)
        alpha = wrap(math.atan2(north, east) - pose.heading_rad - slip)
        curvature = 2.0 * math.sin(alpha) / distance
        wanted_slip = math.asin(max(-0.6, min(0.6, 0.5 * mission.length_m * curvature)))
        wanted = math.atan(2.0 * math.tan(wanted_slip))
        turn = gains.steering_radps * self._tick_s
        self._steering += max(-turn, min(turn, wanted - self._steering))
        accel = max(-gains.brake_mps2, min(gains.accel_mps2, trajectory.accel_mps2))
        return Control2D(accel, self._steering)


def _point_at(trajectory: Trajectory, pose: EgoPose, ahead_m: float) -> tuple[float, float]:
    """The place on the way that lies so far ahead of the one beside the vehicle."""
    points = trajectory.points
    steps = np.diff(points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    offset = np.array([pose.x_m, pose.y_m]) - points[:-1]
    safe = np.maximum(lengths, 1e-9)
    share = np.clip((offset * steps).sum(axis=1) / safe**2, 0.0, 1.0)
    off = np.hypot(*(offset - share[:, None] * steps).T)
    beside = int(np.argmin(off))
    s = along[beside] + share[beside] * lengths[beside] + ahead_m
    if s > along[-1]:  # beyond the end the last direction goes on
        past = (s - along[-1]) / safe[-1]
        end = points[-1] + past * steps[-1]
        return float(end[0]), float(end[1])
    return (
        float(np.interp(s, along, points[:, 0])),
        float(np.interp(s, along, points[:, 1])),
    )
