"""Generator of small point clouds, and motions of clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]


def street(number: int, seed: int = 0) -> Points:
    """Generate 120 m by 120 m of uneven ground, with two walls at right angles."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(-60.0, 60.0, (number // 2, 2))
    height = 0.3 * np.sin(ground[:, 0] / 9.0) + 0.2 * np.cos(ground[:, 1] / 7.0)
    side = number // 4
    along = rng.uniform(-60.0, 60.0, side)
    wall = np.column_stack([along, np.full(side, 20.0), rng.uniform(0.0, 10.0, side)])
    rest = number - number // 2 - side
    along = rng.uniform(-60.0, 60.0, rest)
    gable = np.column_stack([np.full(rest, -30.0), along, rng.uniform(0.0, 8.0, rest)])
    return np.vstack([np.column_stack([ground, height]), wall, gable])


def motion(x: float, y: float, z: float, yaw_deg: float) -> Points:
    yaw, found = np.radians(yaw_deg), np.eye(4)
    found[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    found[:3, 3] = x, y, z
    return found
