"""Time to collision by following every other vehicle through time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

HORIZON_S = 4.0
REACH_M = 60.0
WIDTH_M = 2.2
LEVEL_M = 4.0


def time_to_collision(rows: NDArray[np.void], i: int) -> float:
    """1 - ttc / horizon of the first that comes near, or 0.

    The gap between the discs shrinks at the rate at which the centres approach each other now.
    """
    me = rows[i]
    least = HORIZON_S
    for j, other in enumerate(rows):
        place = np.array([other["x"] - me["x"], other["y"] - me["y"]])
        distance = float(np.hypot(*place))
        if j == i or distance > REACH_M or abs(other["z"] - me["z"]) > LEVEL_M:
            continue
        motion = _velocity(other) - _velocity(me)
        speed = float(np.hypot(*motion))
        approach = -float(place @ motion)
        if approach <= 0.0 or speed * speed < 1e-6:
            continue
        # The least distance of two paths is the part of the place that is square to the motion.
        if abs(place[0] * motion[1] - place[1] * motion[0]) / speed > WIDTH_M:
            continue
        gap = max(distance - 0.5 * float(other["length"]) - 0.5 * float(me["length"]), 0.0)
        least = min(least, gap / (approach / distance))
    return 1.0 - least / HORIZON_S


def _velocity(row: np.void) -> NDArray[np.float64]:
    return np.array([math.cos(row["heading"]), math.sin(row["heading"])]) * float(row["speed"])
