"""Mounting transforms: settings → `Mount`, and points from frame to frame."""

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


def mount_of(config: MountedConfig) -> Mount:
    """The place and the direction of a sensor, as kernels take them."""
    turn = np.zeros((3, 3))
    yaw, pitch, roll = map(math.radians, (config.yaw_deg, config.pitch_deg, config.roll_deg))
    rotation(yaw, pitch, roll, turn)
    return Mount(np.array([config.x_m, config.y_m, config.z_m]), turn)


def mount_matrix(config: MountedConfig) -> NDArray[np.float64]:
    """(3, 4): the sensor's axes (ahead, left, up) as columns and its place, in the vehicle's frame.

    What rays and cameras take of a mount.
    """
    mount = mount_of(config)
    return np.column_stack([mount.turn, mount.place])


def check_place(name: str, config: MountedConfig, body: np.void) -> None:
    """Refuse a sensor outside of the body that it is mounted on.

    `body`: VTYPE of agents' vehicles.

    Raises ConfigError: with the nearest place on the body.
    """
    half_m, half_width_m, height_m = 0.5 * body["length"], 0.5 * body["width"], body["height"]
    for key, low, high in (
        ("x_m", -half_m, half_m),
        ("y_m", -half_width_m, half_width_m),
        ("z_m", 0.0, height_m),
    ):
        value = getattr(config, key)
        if not low - _ROUNDING_M <= value <= high + _ROUNDING_M:
            raise ConfigError(
                f"rig.{name}.{key} = {value!r}: outside of the vehicle, whose body reaches from "
                f"{low:g} to {high:g}; the nearest is {min(max(value, low), high):g}"
            )


def transform(turn: Points, place: Points, points: Points) -> Points:
    """Points (n, 3) of a frame that is turned and placed so, in the frame around it."""
    return points @ turn.T + place


def sensor_to_vehicle(mount: Mount, points: Points) -> Points:
    """Points (n, 3) of the sensor's frame in the vehicle's."""
    return transform(mount.turn, mount.place, points)


def vehicle_to_sensor(mount: Mount, points: Points) -> Points:
    """Points (n, 3) of the vehicle's frame in the sensor's."""
    return (points - mount.place) @ mount.turn


def vehicle_to_world(row: np.void, points: Points) -> Points:
    """Points (n, 3) of the frame of a VEHICLE in the world's."""
    turn, place = _pose(row)
    return transform(turn, place, points)


def world_to_vehicle(row: np.void, points: Points) -> Points:
    """Points (n, 3) of the world in the frame of a VEHICLE."""
    turn, place = _pose(row)
    return (points - place) @ turn


def _pose(row: np.void) -> tuple[Points, Points]:
    turn = np.zeros((3, 3))
    rotation(row["heading"], row["pitch"], 0.0, turn)
    return turn, np.array([row["x"], row["y"], row["z"]])
