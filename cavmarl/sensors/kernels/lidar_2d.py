"""Lidar: distances along equally spaced rays to the bodies of other vehicles.

As highway-env's `LidarObservation`, but rays and boxes meet exactly: there, a vehicle is also drawn
into the cell of its centre, at its distance less half its width.

A vehicle covers few rays. For each one in range the kernel bounds the rays that can meet it, by an
angle that is never too small, and tests only those. The bound needs no accuracy: the test is exact.
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

# What a ray met first.
ECHO = record(
    ("distance", np.float64),  # m; 0 from inside of a body, the range where nothing is
    # its velocity less the own one, in m/s along the ray: positive where it goes away
    # (highway-env's sign); 0 where nothing is
    ("speed", np.float64),
    ("id", np.int64),  # of the vehicle; -1 where nothing is
)

PI = math.pi
TWO_PI = 2.0 * math.pi

# A ray that closes in on a strip by less than this each metre does not reach it within any range.
_PARALLEL = 1e-200


def ray_directions(num_rays: int) -> NDArray[np.float64]:
    """Directions (num_rays, 2), cosine and sine: equally spaced, counter-clockwise from ahead."""
    angles = 2.0 * np.pi * np.arange(num_rays) / num_rays
    return np.stack([cos_all(angles), sin_all(angles)], axis=1)


@kernel
def _ray_to_box(
    x: float, y: float, closing_x: float, closing_y: float, half_length: float, half_width: float
) -> float:
    """Distance along a ray to a box around the origin, 0 inside of it and inf if missed.

    Slabs (Kay, Kajiya: "Ray tracing complex scenes", SIGGRAPH 1986): of the two strips that make
    the box, the one that the ray enters last decides where it meets it.

    Args:
        x: where the ray starts, mirrored into x >= 0.
        y: where the ray starts, mirrored into y >= 0.
        closing_x: the ray's direction, towards the origin: x falls by this much each metre.
        closing_y: the same of y.
        half_length: of the box along x.
        half_width: of the box along y.
    """
    # Negative for a strip that the ray starts in; beyond any range for one that it turns away from.
    enter_x = (x - half_length) / max(closing_x, _PARALLEL)
    enter_y = (y - half_width) / max(closing_y, _PARALLEL)
    distance = max(max(enter_x, enter_y), 0.0)
    there_x = x - closing_x * distance
    there_y = y - closing_y * distance
    # The near side of a strip that was entered is not tested again: by rounding, rays would slip in
    # between two faces. `&` and not `and`: the tests are cheaper than branches on random geometry.
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
    """The rays that can meet a box with its centre at (x, y): the first one and how many.

    Seen from the origin, the box keeps within `across` of the line to its centre and begins no
    nearer than `ahead`: the angle to each side is at most atan(across / ahead) < across / ahead.

    `along`: of the origin from the centre, in m along the box, at least 0. `beside`: the same
    across the box.
    """
    # Both times the distance to the centre, which cancels out.
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
    """Let the rays of `lidar` meet one body."""
    # All in the frame of the vehicle that looks, where the rays are given.
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
    # The body's axes, each turned to point from the sensor towards the body.
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

    Where two vehicles are equally far along a ray, the one with the smaller id counts.

    `rays`: (num_rays, 2) directions in the vehicle's frame, from `ray_directions`. `range_m`: how
    far it sees, in the plane. `out`: ECHO (num_rays,), overwritten.
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
