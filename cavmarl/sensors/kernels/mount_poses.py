"""Where a mounted sensor is and where it looks: sensor → vehicle → world.

Frames are right-handed: x forward, y to the left, z up. A direction is given by yaw (counter-
clockwise seen from above), then pitch (positive upwards), then roll (positive with the left side
up), each about the axes as turned by those before. The vehicle's origin lies on the ground below
the centre of the body.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel


class Mount(NamedTuple):
    """A place and a direction in the vehicle's frame."""

    place: NDArray[np.float64]  # (3,) m
    turn: NDArray[np.float64]  # (3, 3) a vector of the sensor's frame in the vehicle's frame


@kernel
def rotation(yaw: float, pitch: float, roll: float, out: NDArray[np.float64]) -> None:
    """Write the matrix that turns a vector of the turned frame into the one around it.

    `pitch`: rad, positive upwards. `roll`: rad, positive with the left side up. `out`: (3, 3),
    overwritten; its columns are the turned frame's axes.
    """
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    cos_pitch, sin_pitch = math.cos(pitch), math.sin(pitch)
    cos_roll, sin_roll = math.cos(roll), math.sin(roll)
    out[0, 0] = cos_yaw * cos_pitch
    out[1, 0] = sin_yaw * cos_pitch
    out[2, 0] = sin_pitch
    out[0, 1] = -cos_yaw * sin_pitch * sin_roll - sin_yaw * cos_roll
    out[1, 1] = -sin_yaw * sin_pitch * sin_roll + cos_yaw * cos_roll
    out[2, 1] = cos_pitch * sin_roll
    out[0, 2] = -cos_yaw * sin_pitch * cos_roll + sin_yaw * sin_roll
    out[1, 2] = -sin_yaw * sin_pitch * cos_roll - cos_yaw * sin_roll
    out[2, 2] = cos_pitch * cos_roll


@kernel
def turned(matrix: NDArray[np.float64], x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector, turned by a matrix (3, 3)."""
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


@kernel
def sensor_pose(
    row: np.void, mount: Mount, body: NDArray[np.float64], axes: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Where a sensor is in the world, and how it is turned.

    Args:
        row: VEHICLE that carries it.
        mount: on the vehicle.
        body: (3, 3), overwritten: a vector of the vehicle's frame in the world.
        axes: (3, 3), overwritten: a vector of the sensor's frame in the world.

    Returns:
        x, y, z in m.
    """
    rotation(row["heading"], row["pitch"], 0.0, body)
    for column in range(3):
        axes[0, column], axes[1, column], axes[2, column] = turned(
            body, mount.turn[0, column], mount.turn[1, column], mount.turn[2, column]
        )
    x, y, z = turned(body, mount.place[0], mount.place[1], mount.place[2])
    return row["x"] + x, row["y"] + y, row["z"] + z
