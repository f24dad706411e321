"""Mounts: settings converted to a `Mount`, and transforms of points between frames."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.rig import MountedConfig
from cavmarl.core.errors import ConfigError
from cavmarl.sensors.kernels.rig_frames import Mount, rotation

SENSOR_FRAME = "vehicle/{name}"

Points = NDArray[np.float64]

_ROUNDING_M = 1e-9


def mount_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Points:
    """Return the (3, 3) matrix that rotates a vector of a sensor's frame into the vehicle's."""
    turn = np.zeros((3, 3))
    rotation(math.radians(yaw_deg), math.radians(pitch_deg), math.radians(roll_deg), turn)
    return turn


def mount_of(config: MountedConfig) -> Mount:
    """Return the position and orientation of a sensor as a named tuple for kernels."""
    turn = mount_rotation(config.yaw_deg, config.pitch_deg, config.roll_deg)
    return Mount(np.array([config.x_m, config.y_m, config.z_m]), turn)


def mount_matrix(config: MountedConfig) -> NDArray[np.float64]:
    """Return the (3, 4) matrix of a mount, in the vehicle's frame, for rays and cameras.

    Its columns are the sensor's axes (ahead, left, up) and its position.
    """
    mount = mount_of(config)
    return np.column_stack([mount.turn, mount.place])


def check_place(name: str, config: MountedConfig, bodies: NDArray[np.void]) -> None:
    """Check that a sensor lies inside every body on which it is mounted.

    `bodies`: VTYPE (n,) of the vehicles that carry it.

    Raises ConfigError: the sensor lies outside; the message states the nearest valid position.
    """
    if not len(bodies):
        return
    half_m, half_width_m = 0.5 * bodies["length"].min(), 0.5 * bodies["width"].min()
    height_m = bodies["height"].min()
    for key, low, high in (
        ("x_m", -half_m, half_m),
        ("y_m", -half_width_m, half_width_m),
        ("z_m", 0.0, height_m),
    ):
        value = getattr(config, key)
        if not low - _ROUNDING_M <= value <= high + _ROUNDING_M:
            raise ConfigError(
                f"rig.{name}.{key} = {value!r}: outside the vehicle's body, which reaches from "
                f"{low:g} to {high:g}; the nearest valid value is {min(max(value, low), high):g}"
            )


def transform(turn: Points, place: Points, points: Points) -> Points:
    """Transform points (n, 3) from a frame with this rotation and origin to the outer frame."""
    return points @ turn.T + place


def sensor_to_vehicle(mount: Mount, points: Points) -> Points:
    """Transform points (n, 3) from the sensor's frame to the vehicle's."""
    return transform(mount.turn, mount.place, points)
