"""Converts a lidar's echoes to points in the vehicle's frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.stack.stack_types import StackSensor
from cavmarl.sensors.kernels.rig_frames import rotation

Points = NDArray[np.float64]

RANGE_MARGIN_M = 0.05  # distances at least this much below the range are echoes


def lidar_points(lidar: StackSensor, scan: Points, range_m: float = math.inf) -> Points:
    """Return echoes (n, 3), the lowest layer first; x ahead, y to the left, z above the ground.

    `scan`: (layers, rays) distances in m, see `docs/reference/imaging.md`. `range_m`: maximum
    range of used echoes.
    """
    settings = lidar.settings
    points, _ = sensor_points(settings, scan, range_m)
    turn = np.zeros((3, 3))
    yaw, pitch, roll = (math.radians(settings[key]) for key in ("yaw_deg", "pitch_deg", "roll_deg"))
    rotation(yaw, pitch, roll, turn)
    place_m = np.array([settings["x_m"], settings["y_m"], settings["z_m"]])
    found: Points = points @ turn.T + place_m
    return found


def sensor_points(
    settings: Mapping[str, Any], scan: Points, range_m: float = math.inf
) -> tuple[Points, NDArray[np.int64]]:
    """Return echoes (n, 3) in the sensor's frame, and the layer (n,) of each, from 0.

    `settings`: keys of the lidar. `scan`, `range_m`: see `lidar_points`.
    """
    layers, rays = scan.shape
    fov = math.radians(settings["fov_deg"])
    around = settings["fov_deg"] == 360.0
    step = fov / rays if around else fov / max(rays - 1, 1)
    azimuth = np.arange(rays) * step - (0.0 if around else 0.5 * fov)
    elevation = np.zeros(1)
    if layers > 1:
        elevation = np.linspace(settings["lower_deg"], settings["upper_deg"], layers)
    up = np.radians(elevation)[:, None]
    rays_of = np.stack(
        [
            np.cos(up) * np.cos(azimuth),
            np.cos(up) * np.sin(azimuth),
            np.broadcast_to(np.sin(up), scan.shape),
        ],
        axis=-1,
    )
    hit = scan < min(float(settings["range_m"]) - RANGE_MARGIN_M, range_m)
    return rays_of[hit] * scan[hit][:, None], np.nonzero(hit)[0]
