"""Rays from one place of a vehicle that end at bodies, walls and the ground: lidar and radar.

A fan has columns of equal azimuth in the sensor's frame and in each column one ray a channel. A
body covers few columns: those are bounded by an angle that is never too small, and only their rays
are tested, exactly. Ray and prism meet by slabs (Kay, Kajiya: "Ray tracing complex scenes",
SIGGRAPH 1986).

The sensor's frame is that of `scene` moved and turned by `mount`: a matrix (3, 4) whose first three
columns are the sensor's axes (ahead, left, up) and whose last one is its place, all in the
vehicle's frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.bearings import ANGLE_ERROR_RAD, rough_atan2
from cavmarl.core.math.elementary import hypot
from cavmarl.core.math.elementary_arrays import cos_all, sin_all
from cavmarl.core.math.geometry import PI, TWO_PI
from cavmarl.core.records import record

# What a ray met first.
HIT = record(
    ("distance", np.float64),  # m along the ray; 0 from inside of a body, the range for nothing
    ("id", np.int64),  # of the vehicle or pedestrian; -1: none
    ("what", np.int64),  # PRISM row of the panorama; or see `WALL_HIT`
)
NO_HIT = -1
GROUND_HIT = -2
WALL_HIT = -3  # WALL row k of the scene is WALL_HIT - k

# A ray that closes in on a slab by less than this each metre does not reach it within any range.
_PARALLEL = 1e-200
# One that falls by less than this each metre does not meet the ground within any range.
_LEVEL = 1e-9


class Fan(NamedTuple):
    """Which rays there are; A columns and E channels."""

    rays: NDArray[np.float64]  # (A, E, 3) directions in the vehicle's frame
    ground_m: NDArray[np.float64]  # (A, E) where each meets the ground; inf: nowhere
    mount: NDArray[np.float64]  # (3, 4)
    first_rad: float  # azimuth of the first column, in [-pi, pi]
    step_rad: float  # between columns, positive: counter-clockwise
    per_rad: float  # columns
    range_m: float
    tilted: bool  # whether the sensor's z axis is another than the vehicle's
    looks_down: bool  # whether any ray meets the ground within the range


def make_fan(
    mount: NDArray[np.float64],
    azimuths_rad: tuple[float, float, int],
    elevations_rad: NDArray[np.float64],
    range_m: float,
) -> Fan:
    """The rays of a sensor.

    Args:
        mount: (3, 4) axes and place in the vehicle's frame.
        azimuths_rad: of the first column, from one to the next, and how many; at most a full turn.
        elevations_rad: (E,) of the channels over the sensor's own plane.
        range_m: how far it sees along each ray.
    """
    first_rad, step_rad, columns = azimuths_rad
    azimuth = (first_rad + step_rad * np.arange(columns))[:, np.newaxis]
    elevation = np.asarray(elevations_rad)[np.newaxis, :]
    own = np.stack(
        [
            cos_all(azimuth) * cos_all(elevation),
            sin_all(azimuth) * cos_all(elevation),
            sin_all(elevation) * np.ones_like(azimuth),
        ],
        axis=2,
    )
    # Not by `@`: what a matrix product gives can depend on the machine's threads.
    rays = own[..., :1] * mount[:, 0] + own[..., 1:2] * mount[:, 1] + own[..., 2:] * mount[:, 2]
    down = -rays[:, :, 2]
    ground_m = np.full(down.shape, np.inf)
    np.divide(mount[2, 3], down, out=ground_m, where=down > _LEVEL)
    tilted = bool(mount[2, 0] != 0.0 or mount[2, 1] != 0.0)
    looks_down = bool((ground_m < range_m).any())
    return Fan(
        rays, ground_m, mount, first_rad, step_rad, 1.0 / step_rad, range_m, tilted, looks_down
    )


@kernel
def _columns(fan: Fan, middle_rad: float, spread_rad: float) -> tuple[int, int, int]:
    """The columns within `spread_rad` of an azimuth: [begin, end), and those before the third."""
    count = fan.rays.shape[0]
    spread_rad += ANGLE_ERROR_RAD
    if spread_rad >= PI:
        return 0, count, 0
    # From here on in columns.
    turn = TWO_PI * fan.per_rad
    low = (middle_rad - spread_rad - fan.first_rad) * fan.per_rad
    if low < 0.0:
        low += turn
    if low < 0.0:
        low += turn
    if low >= turn:
        low -= turn
    high = low + 2.0 * spread_rad * fan.per_rad
    begin = min(math.ceil(low), count)
    end = min(math.floor(high) + 1, count)
    wrapped = min(math.floor(high - turn) + 1, begin)
    return begin, max(begin, end), max(wrapped, 0)


@kernel
def _columns_of_ball(fan: Fan, x: float, y: float, z: float, radius: float) -> tuple[int, int, int]:
    """The columns that can meet a ball at a place in the vehicle's frame."""
    mount = fan.mount
    dx = x - mount[0, 3]
    dy = y - mount[1, 3]
    dz = z - mount[2, 3]
    ahead = dx * mount[0, 0] + dy * mount[1, 0] + dz * mount[2, 0]
    left = dx * mount[0, 1] + dy * mount[1, 1] + dz * mount[2, 1]
    squared = ahead * ahead + left * left
    if squared <= radius * radius:
        return 0, fan.rays.shape[0], 0
    sine = radius / math.sqrt(squared)
    # asin(s) <= s + (pi / 2 - 1) s^3 in [0, 1].
    return _columns(fan, rough_atan2(left, ahead), sine + 0.5708 * sine * sine * sine)


@kernel
def _ray_to_prism(
    place: tuple[float, float, float],
    closing: tuple[float, float, float],
    half: tuple[float, float, float],
) -> float:
    """Distance along a ray to a box around the origin, 0 inside of it and inf if missed.

    `place`: where the ray starts, mirrored into the first octant. `closing`: the ray's direction,
    towards the origin: how fast each coordinate falls. `half`: of the box's sides.
    """
    # Negative for a slab that the ray starts in; beyond any range for one that it turns away from.
    enter_x = (place[0] - half[0]) / max(closing[0], _PARALLEL)
    enter_y = (place[1] - half[1]) / max(closing[1], _PARALLEL)
    enter_z = (place[2] - half[2]) / max(closing[2], _PARALLEL)
    distance = max(max(enter_x, enter_y), max(enter_z, 0.0))
    there_x = place[0] - closing[0] * distance
    there_y = place[1] - closing[1] * distance
    there_z = place[2] - closing[2] * distance
    # The near side of a slab that was entered is not tested again: by rounding, rays would slip in
    # between two faces.
    inside_x = (there_x >= -half[0]) & (there_x <= max(place[0], half[0]))
    inside_y = (there_y >= -half[1]) & (there_y <= max(place[1], half[1]))
    inside_z = (there_z >= -half[2]) & (there_z <= max(place[2], half[2]))
    return distance if inside_x & inside_y & inside_z else np.inf


@kernel
def _between(columns: tuple[int, int, int], first: int, last: int) -> tuple[int, int, int, int]:
    """Of the columns that `_columns` tells, those in [first, last): [begin, end) and a second."""
    begin, end, wrapped = columns
    begin = min(max(begin, first), last)
    end = min(max(end, begin), last)
    wrapped = min(wrapped, last)
    return begin, end, first, max(wrapped, first)


@kernel
def _cast_at_prism(
    fan: Fan, prisms: NDArray[np.void], k: int, first: int, last: int, hits: NDArray[np.void]
) -> None:
    """Let the rays that can meet a body meet it; of equally near bodies the smaller id counts."""
    prism = prisms[k]
    cos = prism["cos"]
    sin = prism["sin"]
    middle = 0.5 * (prism["bottom"] + prism["top"])
    half_height = 0.5 * (prism["top"] - prism["bottom"])
    dx = prism["x"] - fan.mount[0, 3]
    dy = prism["y"] - fan.mount[1, 3]
    dz = middle - fan.mount[2, 3]
    limit = fan.range_m + prism["radius"]
    if dx * dx + dy * dy >= limit * limit:
        return
    radius = prism["radius"]
    if fan.tilted:
        radius = math.sqrt(radius * radius + half_height * half_height)
    columns = _columns_of_ball(fan, prism["x"], prism["y"], middle, radius)
    begin, end, start, wrapped = _between(columns, first, last)
    if begin == end and start == wrapped:
        return
    # The body's axes, each turned to point from the sensor towards the body.
    along = dx * cos + dy * sin
    beside = dy * cos - dx * sin
    along_sign = math.copysign(1.0, along)
    beside_sign = math.copysign(1.0, beside)
    up_sign = math.copysign(1.0, dz)
    place = (abs(along), abs(beside), abs(dz))
    half = (prism["half_length"], prism["half_width"], half_height)
    rays = fan.rays
    for n in range(end - begin + wrapped - start):
        a = begin + n if n < end - begin else start + n - (end - begin)
        for e in range(rays.shape[1]):
            closing = (
                (rays[a, e, 0] * cos + rays[a, e, 1] * sin) * along_sign,
                (rays[a, e, 1] * cos - rays[a, e, 0] * sin) * beside_sign,
                rays[a, e, 2] * up_sign,
            )
            distance = _ray_to_prism(place, closing, half)
            hit = hits[a, e]
            if distance < hit["distance"] or (
                distance == hit["distance"] and prism["id"] < hit["id"]
            ):
                hit["distance"] = distance
                hit["id"] = prism["id"]
                hit["what"] = k


@kernel
def _cast_at_wall(
    fan: Fan, walls: NDArray[np.void], k: int, first: int, last: int, hits: NDArray[np.void]
) -> None:
    """Let the rays that can meet a wall meet it; bodies and earlier walls count before it."""
    wall = walls[k]
    x = fan.mount[0, 3]
    y = fan.mount[1, 3]
    z = fan.mount[2, 3]
    ax = wall["ax"] - x
    ay = wall["ay"] - y
    bx = wall["bx"] - x
    by = wall["by"] - y
    columns = _columns_of_wall(fan, wall, ax, ay, bx, by)
    begin, end, start, wrapped = _between(columns, first, last)
    facing = ax * by - ay * bx
    rays = fan.rays
    for n in range(end - begin + wrapped - start):
        a = begin + n if n < end - begin else start + n - (end - begin)
        for e in range(rays.shape[1]):
            ray_x = rays[a, e, 0]
            ray_y = rays[a, e, 1]
            # On which side of the ray the ends lie: walls that share an end leave no gap.
            side_a = ray_x * ay - ray_y * ax
            side_b = ray_x * by - ray_y * bx
            if (side_a > 0.0) == (side_b > 0.0):
                continue
            distance = facing / (side_b - side_a)
            up = z + distance * rays[a, e, 2]
            hit = hits[a, e]
            if 0.0 <= distance < hit["distance"] and 0.0 <= up <= wall["height"]:
                hit["distance"] = distance
                hit["id"] = -1
                hit["what"] = WALL_HIT - k


@kernel
def _columns_of_wall(
    fan: Fan, wall: np.void, ax: float, ay: float, bx: float, by: float
) -> tuple[int, int, int]:
    """The columns that can meet a wall whose ends are seen at a and b."""
    if fan.tilted:
        half_height = 0.5 * wall["height"]
        half_length = 0.5 * hypot(bx - ax, by - ay)
        return _columns_of_ball(
            fan,
            0.5 * (wall["ax"] + wall["bx"]),
            0.5 * (wall["ay"] + wall["by"]),
            half_height,
            hypot(half_length, half_height),
        )
    yaw_cos = fan.mount[0, 0]
    yaw_sin = fan.mount[1, 0]
    across = ax * by - ay * bx
    along = ax * bx + ay * by
    if across == 0.0 and along == 0.0:
        return 0, fan.rays.shape[0], 0  # the sensor is at an end of it
    from_a = rough_atan2(ay * yaw_cos - ax * yaw_sin, ax * yaw_cos + ay * yaw_sin)
    # From a to b the short way round.
    turn = rough_atan2(across, along)
    if abs(turn) > PI - 2.0 * ANGLE_ERROR_RAD:
        return 0, fan.rays.shape[0], 0  # it may be the other way round
    # Two angles are wrong, and not one.
    return _columns(fan, from_a + 0.5 * turn, 0.5 * abs(turn) + ANGLE_ERROR_RAD)


@kernel
def cast(
    fan: Fan,
    prisms: NDArray[np.void],
    num_prisms: int,
    walls: NDArray[np.void],
    num_walls: int,
    first: int,
    last: int,
    hits: NDArray[np.void],
) -> None:
    """Find what each ray of a fan meets first; the ground only where nothing else is.

    `prisms`: PRISM (C,) of the panorama. `walls`: WALL (num_walls,) of the panorama. `last`: the
    one after the last that is cast. `hits`: HIT (A, E), overwritten in these columns.
    """
    for a in range(first, last):
        for e in range(hits.shape[1]):
            hit = hits[a, e]
            hit["distance"] = fan.range_m
            hit["id"] = -1
            hit["what"] = NO_HIT
    for k in range(num_prisms):
        _cast_at_prism(fan, prisms, k, first, last, hits)
    for k in range(num_walls):
        _cast_at_wall(fan, walls, k, first, last, hits)
    if not fan.looks_down:
        return
    for a in range(first, last):
        for e in range(hits.shape[1]):
            hit = hits[a, e]
            if hit["what"] == NO_HIT and fan.ground_m[a, e] < fan.range_m:
                hit["distance"] = fan.ground_m[a, e]
                hit["what"] = GROUND_HIT
