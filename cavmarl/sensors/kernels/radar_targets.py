"""Radar: the nearest targets, with range, azimuth and radial speed.

A target is a body or a building of which a ray of the fan meets something first; its echo is the
nearest of those. The radial speed is that of the target's centre less that of the sensor, along the
ray: positive where the distance grows. The ground and clutter give no echo.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.sensors.kernels.panorama import Panorama
from cavmarl.sensors.kernels.ray_fan import WALL_HIT, Fan

TARGET = np.dtype(
    [
        ("range", np.float64),  # m
        ("azimuth", np.float64),  # rad in the sensor's frame, positive to the left
        ("speed", np.float64),  # m/s, positive away
        ("body", np.int64),  # 1: a body, 0: a building
        ("id", np.int64),  # of the vehicle, or number of the building
    ],
    align=True,
)


@kernel
def _radial_speed(fan: Fan, panorama: Panorama, ego: np.void, hit: np.void, a: int) -> float:
    """Of what column `a` has met."""
    ray_x = fan.rays[a, 0, 0]
    ray_y = fan.rays[a, 0, 1]
    # The sensor turns with the vehicle, about its centre.
    x = -(ego["speed"] - ego["yaw_rate"] * fan.mount[1, 3])
    y = -(ego["yaw_rate"] * fan.mount[0, 3])
    if hit["what"] >= 0:
        prism = panorama.prisms[hit["what"]]
        x += prism["speed"] * prism["cos"]
        y += prism["speed"] * prism["sin"]
    speed: float = x * ray_x + y * ray_y
    return speed


@kernel
def _place_of(targets: NDArray[np.void], found: int, body: int, number: int) -> int:
    """Where a target is in the list; `found` if it is new."""
    for k in range(found - 1, -1, -1):
        if targets[k]["body"] == body and targets[k]["id"] == number:
            return k
    return found


@kernel
def _before(target: np.void, other: np.void) -> bool:
    """Whether a target comes before another: by range, then by kind and number."""
    if target["range"] != other["range"]:
        return bool(target["range"] < other["range"])
    if target["body"] != other["body"]:
        return bool(target["body"] > other["body"])
    return bool(target["id"] < other["id"])


@kernel
def detect(
    fan: Fan,
    panorama: Panorama,
    ego: np.void,
    hits: NDArray[np.void],
    targets: NDArray[np.void],
    order: NDArray[np.int32],
) -> int:
    """List what the rays have met, nearest first.

    `fan`: of one channel. `hits`: HIT (A, 1), from `cast`. `targets`: TARGET (A,), overwritten up
    to the returned number, in no order. `order`: (A,) likewise: which target is the next nearest.

    Returns:
        how many there are.
    """
    found = 0
    for a in range(hits.shape[0]):
        hit = hits[a, 0]
        wall = WALL_HIT - hit["what"]
        if hit["what"] < 0 and wall < 0:
            continue
        body = 1 if hit["what"] >= 0 else 0
        number = hit["id"] if body == 1 else panorama.walls[wall]["building"]
        place = _place_of(targets, found, body, number)
        target = targets[place]
        if place == found or hit["distance"] < target["range"]:
            target["range"] = hit["distance"]
            target["azimuth"] = fan.first_rad + a * fan.step_rad
            target["speed"] = _radial_speed(fan, panorama, ego, hit, a)
            target["body"] = body
            target["id"] = number
        found = max(found, place + 1)
    for k in range(found):
        place = k
        while place > 0 and _before(targets[k], targets[order[place - 1]]):
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    return found
