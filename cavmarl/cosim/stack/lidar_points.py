"""Converts a lidar's echoes to points in the vehicle's frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.stack.stack_types import StackSensor
from cavmarl.sensors.mounted.lidar import has_echo, lidar_directions
from cavmarl.sensors.mounted.mount_transforms import mount_rotation, transform

Points = NDArray[np.float64]


def lidar_points(lidar: StackSensor, scan: Points, range_m: float = math.inf) -> Points:
    """Return echoes (n, 3), the lowest layer first; x ahead, y to the left, z above the ground.

    `scan`: (layers, rays) distances in m, see `docs/reference/imaging.md`. `range_m`: maximum
    range of used echoes.
    """
    settings = lidar.settings
    points, _ = sensor_points(settings, scan, range_m)
    turn = mount_rotation(settings["yaw_deg"], settings["pitch_deg"], settings["roll_deg"])
    return transform(turn, np.array([settings["x_m"], settings["y_m"], settings["z_m"]]), points)


def sensor_points(
    settings: Mapping[str, Any], scan: Points, range_m: float = math.inf
) -> tuple[Points, NDArray[np.int64]]:
    """Return echoes (n, 3) in the sensor's frame, and the layer (n,) of each, from 0.

    `settings`: keys of the lidar. `scan`, `range_m`: see `lidar_points`.
    """
    layers, rays = scan.shape
    directions = lidar_directions(
        settings["fov_deg"], rays, settings["lower_deg"], settings["upper_deg"], layers
    )
    hit = has_echo(scan, settings["range_m"]) & (scan < range_m)
    return directions[hit] * scan[hit][:, None], np.nonzero(hit)[0]
