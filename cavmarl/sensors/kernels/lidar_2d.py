"""Lidar: distances along equally spaced rays to the bodies of other vehicles.

Unlike in highway-env's `LidarObservation`, rays and boxes are intersected exactly.

A vehicle covers few rays. For each vehicle in range, the kernel computes an upper bound of the
angle that the vehicle covers, and tests only the rays within it. The bound may be loose, because
the test is exact.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.bearings import ANGLE_ERROR_RAD, rough_atan2
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.elementary_arrays import cos_all, sin_all
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.records import record

# The first hit of a ray.
ECHO = record(
    ("distance", np.float64),  # m; 0 inside a body, the range if nothing is hit
    # speed of the vehicle relative to the ego vehicle along the ray, in m/s, positive away (as in
    # highway-env); 0 if nothing is hit
    ("speed", np.float64),
    ("id", np.int64),  # id of the vehicle; -1 if nothing is hit
)

PI = math.pi
TWO_PI = 2.0 * math.pi

# A ray that approaches a strip by less than this per metre does not reach the strip in any range.
_PARALLEL = 1e-200


def ray_directions(num_rays: int) -> NDArray[np.float64]:
    """Return cosine and sine (num_rays, 2) of equally spaced rays, counter-clockwise from ahead."""
    angles = 2.0 * np.pi * np.arange(num_rays) / num_rays
    return np.stack([cos_all(angles), sin_all(angles)], axis=1)


@kernel
def _ray_to_box(
    x: float, y: float, closing_x: float, closing_y: float, half_length: float, half_width: float
) -> float:
    """Return the distance along a ray to a box around the origin; 0 inside, inf if missed.

    The method is that of slabs (Kay, Kajiya: "Ray tracing complex scenes", SIGGRAPH 1986): the box
    is the intersection of two strips, and the ray hits it where it enters the second strip.

    Args:
        x: start of the ray, mirrored to x >= 0.
        y: start of the ray, mirrored to y >= 0.
        closing_x: decrease of x per metre along the ray.
        closing_y: decrease of y per metre along the ray.
        half_length: half the box's size along x.
        half_width: half the box's size along y.
    """
    # These are negative if the ray starts in the strip, and huge if it points away from the strip.
    enter_x = (x - half_length) / max(closing_x, _PARALLEL)
    enter_y = (y - half_width) / max(closing_y, _PARALLEL)
    distance = max(max(enter_x, enter_y), 0.0)
    there_x = x - closing_x * distance
    there_y = y - closing_y * distance
    # The near side of an entered strip is not tested again: rounding would let rays pass between
    # two faces. `&` instead of `and`: the tests are cheaper than branches on random geometry.
    inside_x = (there_x >= -half_length) & (there_x <= max(x, half_length))
    inside_y = (there_y >= -half_width) & (there_y <= max(y, half_width))
    return distance if inside_x & inside_y else np.inf


@kernel
def _rays_over(
    x: float,
    y: float,
    along: float,
    beside: float,
    half_length: float,
    half_width: float,
    rays: int,
) -> tuple[int, int]:
    """Return the first ray that can hit a box with centre (x, y), and the number of such rays.

    Seen from the origin, the box is within `across` of the line to its centre, and nowhere nearer
    than `ahead`: the angle to each side is at most atan(across / ahead) < across / ahead.

    `along`, `beside`: position of the origin from the centre along and across the box, in m, at
    least 0.
    """
    # Both lengths are multiplied by the distance to the centre, which cancels in the ratio.
    ahead = x * x + y * y - (half_length * along + half_width * beside)
    across = half_length * beside + half_width * along
    if across >= (PI - ANGLE_ERROR_RAD) * ahead:
        return 0, rays
    spread = across / ahead + ANGLE_ERROR_RAD
    angle = rough_atan2(y, x)
    per_rad = rays / TWO_PI
    first = math.ceil((angle - spread) * per_rad)
    last = math.floor((angle + spread) * per_rad)
    return first + rays if first < 0 else first, min(last - first + 1, rays)


@kernel
def _scan_body(
    body: np.void,
    ego: np.void,
    ego_cos: float,
    ego_sin: float,
    rays: NDArray[np.float64],
    out: NDArray[np.void],
) -> None:
    """Intersect the rays of `lidar` with one body."""
    # Transform the body to the frame of the ego vehicle, in which the rays are given.
    dx = body["x"] - ego["x"]
    dy = body["y"] - ego["y"]
    x = dx * ego_cos + dy * ego_sin
    y = dy * ego_cos - dx * ego_sin
    cos = body["cos"] * ego_cos + body["sin"] * ego_sin
    sin = body["sin"] * ego_cos - body["cos"] * ego_sin
    velocity_x = body["speed"] * cos - ego["speed"]
    velocity_y = body["speed"] * sin
    half_length = body["half_length"]
    half_width = body["half_width"]
    # The body's axes, each flipped to point away from the sensor.
    along = x * cos + y * sin
    beside = y * cos - x * sin
    along_sign = math.copysign(1.0, along)
    beside_sign = math.copysign(1.0, beside)
    along = abs(along)
    beside = abs(beside)
    num_rays = rays.shape[0]
    ray, count = 0, num_rays
    if x * x + y * y > body["radius"] * body["radius"]:
        ray, count = _rays_over(x, y, along, beside, half_length, half_width, num_rays)
    for _ in range(count):
        ray_x = rays[ray, 0]
        ray_y = rays[ray, 1]
        distance = _ray_to_box(
            along,
            beside,
            (ray_x * cos + ray_y * sin) * along_sign,
            (ray_y * cos - ray_x * sin) * beside_sign,
            half_length,
            half_width,
        )
        echo = out[ray]
        if distance < echo["distance"] or (
            distance == echo["distance"] and body["id"] < echo["id"]
        ):
            echo["distance"] = distance
            echo["speed"] = velocity_x * ray_x + velocity_y * ray_y
            echo["id"] = body["id"]
        ray = ray + 1 if ray + 1 < num_rays else 0


@kernel
def lidar(
    rows: NDArray[np.void],
    row: int,
    grid: Grid,
    rays: NDArray[np.float64],
    range_m: float,
    out: NDArray[np.void],
) -> None:
    """Scan around one vehicle, from its centre, for other vehicles on its level.

    At equal distance along a ray, the vehicle with the smaller id is reported.

    `rays`: (num_rays, 2) directions in the vehicle's frame, from `ray_directions`. `range_m`: range
    in the plane. `out`: ECHO (num_rays,), overwritten.
    """
    ego = rows[row]
    ego_cos, ego_sin = cos_sin(ego["heading"])
    for r in range(out.size):
        echo = out[r]
        echo["distance"] = range_m
        echo["speed"] = 0.0
        echo["id"] = -1
    reach = range_m + grid.largest[0]
    first_column, last_column = cell_columns(grid, ego["x"], reach)
    first_row, last_row = cell_rows(grid, ego["y"], reach)
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = grid.bodies[b]
            dx = body["x"] - ego["x"]
            dy = body["y"] - ego["y"]
            limit = range_m + body["radius"]
            if (
                dx * dx + dy * dy < limit * limit
                and body["row"] != row
                and abs(body["z"] - ego["z"]) <= LEVEL_HEIGHT_M
            ):
                _scan_body(body, ego, ego_cos, ego_sin, rays, out)
