"""Ray casting from one point of a vehicle to bodies, walls and the ground, for lidar and radar.

A fan consists of columns; a column has one ray per channel, all with the same azimuth in the
sensor's frame. A body covers few columns: only columns within an upper bound of the body's angle
are tested, exactly. Rays and prisms are intersected by slabs (Kay, Kajiya: "Ray tracing complex
scenes", SIGGRAPH 1986).

`mount` transforms the sensor's frame to the vehicle's: a matrix (3, 4) of the sensor's axes (ahead,
left, up) and its position, all as columns in the vehicle's frame.
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

# The first hit of a ray.
HIT = record(
    ("distance", np.float64),  # m along the ray; 0 inside a body, the range without a hit
    ("id", np.int64),  # id of the vehicle or pedestrian; -1: none
    ("what", np.int64),  # row in PRISM of the panorama, or a code below
)
NO_HIT = -1
GROUND_HIT = -2
WALL_HIT = -3  # WALL row k of the scene is WALL_HIT - k

# A ray that approaches a slab by less than this per metre does not reach the slab in any range.
_PARALLEL = 1e-200
# A ray that falls by less than this per metre does not meet the ground in any range.
_LEVEL = 1e-9


class Fan(NamedTuple):
    """The rays of a sensor, in A columns and E channels."""

    rays: NDArray[np.float64]  # (A, E, 3) directions in the vehicle's frame
    ground_m: NDArray[np.float64]  # (A, E) distance to the ground; inf: never met
    mount: NDArray[np.float64]  # (3, 4)
    first_rad: float  # azimuth of the first column, in [-pi, pi]
    step_rad: float  # angle between columns, positive counter-clockwise
    per_rad: float  # columns per rad
    range_m: float
    tilted: bool  # whether the sensor's z axis differs from the vehicle's
    looks_down: bool  # whether any ray meets the ground within the range


def ray_directions(
    azimuths_rad: tuple[float, float, int], elevations_rad: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the unit vectors (A, E, 3) of the rays in the sensor's frame.

    `azimuths_rad`, `elevations_rad`: as in `make_fan`.
    """
    first_rad, step_rad, columns = azimuths_rad
    azimuth = (first_rad + step_rad * np.arange(columns))[:, np.newaxis]
    elevation = np.asarray(elevations_rad)[np.newaxis, :]
    return np.stack(
        [
            cos_all(azimuth) * cos_all(elevation),
            sin_all(azimuth) * cos_all(elevation),
            sin_all(elevation) * np.ones_like(azimuth),
        ],
        axis=2,
    )


def make_fan(
    mount: NDArray[np.float64],
    azimuths_rad: tuple[float, float, int],
    elevations_rad: NDArray[np.float64],
    range_m: float,
) -> Fan:
    """Create the rays of a sensor.

    Args:
        mount: (3, 4) axes and position in the vehicle's frame.
        azimuths_rad: first azimuth, step, and number of columns; at most a full circle.
        elevations_rad: (E,) elevation of each channel in the sensor's frame.
        range_m: range along each ray.
    """
    first_rad, step_rad, _ = azimuths_rad
    own = ray_directions(azimuths_rad, elevations_rad)
    # `@` is avoided: its result can depend on the number of threads.
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
    """Return the columns within `spread_rad` of an azimuth: [begin, end) and [0, wrapped)."""
    count = fan.rays.shape[0]
    spread_rad += ANGLE_ERROR_RAD
    if spread_rad >= PI:
        return 0, count, 0
    # The unit is columns from here on.
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
    """Return the columns that can meet a sphere; its centre is in the vehicle's frame."""
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
    """Return the distance along a ray to a box around the origin; 0 inside, inf if missed.

    `place`: start of the ray, mirrored into the first octant. `closing`: decrease of each
    coordinate per metre along the ray. `half`: half the sizes of the box.
    """
    # These are negative if the ray starts in the slab, and huge if it points away from the slab.
    enter_x = (place[0] - half[0]) / max(closing[0], _PARALLEL)
    enter_y = (place[1] - half[1]) / max(closing[1], _PARALLEL)
    enter_z = (place[2] - half[2]) / max(closing[2], _PARALLEL)
    distance = max(max(enter_x, enter_y), max(enter_z, 0.0))
    there_x = place[0] - closing[0] * distance
    there_y = place[1] - closing[1] * distance
    there_z = place[2] - closing[2] * distance
    # The near side of an entered slab is not tested again: rounding would let rays pass between two
    # faces.
    inside_x = (there_x >= -half[0]) & (there_x <= max(place[0], half[0]))
    inside_y = (there_y >= -half[1]) & (there_y <= max(place[1], half[1]))
    inside_z = (there_z >= -half[2]) & (there_z <= max(place[2], half[2]))
    return distance if inside_x & inside_y & inside_z else np.inf


@kernel
def _between(columns: tuple[int, int, int], first: int, last: int) -> tuple[int, int, int, int]:
    """Clip the two ranges of `_columns` to [first, last)."""
    begin, end, wrapped = columns
    begin = min(max(begin, first), last)
    end = min(max(end, begin), last)
    wrapped = min(wrapped, last)
    return begin, end, first, max(wrapped, first)


@kernel
def _cast_at_prism(
    fan: Fan, prisms: NDArray[np.void], k: int, first: int, last: int, hits: NDArray[np.void]
) -> None:
    """Intersect a body with the rays that can meet it; on a tie, keep the smaller id."""
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
    # The body's axes, each flipped to point away from the sensor.
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
    """Intersect a wall with the rays that can meet it; on a tie, keep the earlier hit."""
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
            # Sides of the ray on which the ends lie; walls that share an end leave no gap.
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
    """Return the columns that can meet a wall with ends a and b, relative to the sensor."""
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
        return 0, fan.rays.shape[0], 0  # the sensor is at an end of the wall
    from_a = rough_atan2(ay * yaw_cos - ax * yaw_sin, ax * yaw_cos + ay * yaw_sin)
    # The angle from a to b, the short way round.
    turn = rough_atan2(across, along)
    if abs(turn) > PI - 2.0 * ANGLE_ERROR_RAD:
        return 0, fan.rays.shape[0], 0  # rounding may have chosen the long way round
    # Both angles are approximate, so the error bound is added a second time.
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
    """Find the first hit of each ray of a fan; the ground counts only where nothing else is hit.

    `prisms`: PRISM (C,) of the panorama. `walls`: WALL (num_walls,) of the panorama. `first`,
    `last`: the columns [first, last) to cast. `hits`: HIT (A, E), overwritten in these columns.
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
