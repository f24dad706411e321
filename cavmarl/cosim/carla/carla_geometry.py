"""CARLA's frame: x east, y south, z up, left-handed; yaw clockwise seen from above, in degrees.

Pitch is positive upwards, roll is positive with the right side down. Rotations are applied in the
order roll, pitch, yaw, as in CARLA's transforms. Angles in cavmarl's records are in rad,
counter-clockwise, in a right-handed frame with y north.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Vector = tuple[float, float, float]

ZERO: Vector = (0.0, 0.0, 0.0)


class CarlaPose(NamedTuple):
    """A place in m and a rotation in degrees, in CARLA's frame."""

    x: float
    y: float
    z: float
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0

    @property
    def place(self) -> Vector:
        return self.x, self.y, self.z

    def packed(self) -> list[list[float]]:
        """Return the pose as it is sent."""
        return [[self.x, self.y, self.z], [self.pitch, self.yaw, self.roll]]

    def at(self, place: Vector) -> CarlaPose:
        """Return a pose with the same rotation at another place."""
        return CarlaPose(*place, self.pitch, self.yaw, self.roll)


def carla_pose(x: float, y: float, z: float, heading: float, pitch: float = 0.0) -> CarlaPose:
    """Return a pose of cavmarl in CARLA's frame."""
    return CarlaPose(x, -y, z, math.degrees(pitch), -math.degrees(heading), 0.0)


def axes_of(pose: CarlaPose) -> Matrix:
    """Return the axes ahead, right and up of a pose, as columns (3, 3) in CARLA's frame."""
    pitch, yaw, roll = (math.radians(angle) for angle in pose[3:])
    cos_p, sin_p, cos_y, sin_y = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    cos_r, sin_r = math.cos(roll), math.sin(roll)
    return np.array(
        [
            [
                cos_p * cos_y,
                cos_y * sin_p * sin_r - sin_y * cos_r,
                -cos_y * sin_p * cos_r - sin_y * sin_r,
            ],
            [
                cos_p * sin_y,
                sin_y * sin_p * sin_r + cos_y * cos_r,
                -sin_y * sin_p * cos_r + cos_y * sin_r,
            ],
            [sin_p, -cos_p * sin_r, cos_p * cos_r],
        ]
    )


def compose(outer: CarlaPose, inner: CarlaPose) -> CarlaPose:
    """Return a pose that is given relative to `outer`, in the frame of `outer`."""
    turn = axes_of(outer)
    return _pose_of(turn @ inner.place + outer.place, turn @ axes_of(inner))


def relative(outer: CarlaPose, inner: CarlaPose) -> CarlaPose:
    """Return `inner` relative to `outer`; the inverse of `compose`."""
    turn = axes_of(outer).T
    shift = np.array(inner.place) - outer.place
    return _pose_of(turn @ shift, turn @ axes_of(inner))


def _pose_of(place: Matrix, axes: Matrix) -> CarlaPose:
    x, y, z = place.tolist()
    pitch = math.asin(min(1.0, max(-1.0, axes[2, 0])))
    yaw = math.atan2(axes[1, 0], axes[0, 0])
    roll = math.atan2(-axes[2, 1], axes[2, 2])
    return CarlaPose(x, y, z, *map(math.degrees, (pitch, yaw, roll)))


def mount_in_vehicle(pose: CarlaPose) -> Matrix:
    """Return a pose relative to a vehicle as a (3, 4) mount for the kernels of sensors.

    Its columns are the axes ahead, left and up, and the place, in the vehicle's right-handed frame.
    """
    turn = axes_of(pose)
    mount = np.column_stack([turn[:, 0], -turn[:, 1], turn[:, 2], pose.place])
    mount[1] = -mount[1]
    return np.ascontiguousarray(mount)
