"""Find the objects that rays and pixels hit by testing each object; a body is six half-spaces.

Coordinates are in the frame of the vehicle. `margin` enlarges each body and wall, to find cases in
which rounding decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEVEL_HEIGHT_M = 4.0

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Echo:
    """The object that a ray hits: ("body", id), ("wall", building), ("ground", 0) or ("", 0)."""

    distance: float
    what: tuple[str, int] = ("", 0)


def turn(yaw: float, pitch: float, roll: float) -> Vector:
    """Return the (3, 3) axes of a frame after yaw, pitch (nose up) and roll (left side up)."""
    about_z = np.array(
        [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
    )
    about_y = np.array(
        [[math.cos(pitch), 0, -math.sin(pitch)], [0, 1, 0], [math.sin(pitch), 0, math.cos(pitch)]]
    )
    about_x = np.array(
        [[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]
    )
    matrix: Vector = about_z @ about_y @ about_x
    return matrix


def to_vehicle(ego: np.void, x: float, y: float, z: float) -> Vector:
    """Transform a point of the world to the frame of a vehicle."""
    axes = turn(ego["heading"], ego["pitch"], 0.0)
    place: Vector = axes.T @ np.array([x - ego["x"], y - ego["y"], z - ego["z"]])
    return place


def seen_bodies(rows: NDArray[np.void], row: int) -> list[np.void]:
    """Return all other vehicles on the level of the ego vehicle."""
    z = rows[row]["z"]
    return [o for i, o in enumerate(rows) if i != row and abs(o["z"] - z) <= LEVEL_HEIGHT_M]


def ray_to_body(start: Vector, ray: Vector, ego: np.void, body: np.void, margin: float) -> float:
    """Return the distance to a body in lengths of the ray; 0 if inside, inf if the ray misses."""
    base = to_vehicle(ego, body["x"], body["y"], body["z"])
    heading = body["heading"] - ego["heading"]
    along = np.array([math.cos(heading), math.sin(heading), 0.0])
    across = np.array([-math.sin(heading), math.cos(heading), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    sides = [
        (along, 0.5 * body["length"]), (-along, 0.5 * body["length"]),
        (across, 0.5 * body["width"]), (-across, 0.5 * body["width"]),
        (up, float(body["height"])), (-up, 0.0),
    ]  # fmt: skip
    enter, leave = 0.0, math.inf
    for normal, offset in sides:
        outside = float(normal @ (start - base) - offset - margin)
        closing = float(normal @ ray)
        if closing == 0.0:
            if outside > 0.0:
                return math.inf
        elif closing < 0.0:
            enter = max(enter, -outside / closing)
        else:
            leave = min(leave, -outside / closing)
    return enter if enter <= leave else math.inf


def ray_to_wall(start: Vector, ray: Vector, ego: np.void, wall: np.void, margin: float) -> float:
    """Return the distance to a wall (from z = 0 up) in lengths of the ray; inf if it misses."""
    axes = turn(ego["heading"], 0.0, 0.0)[:2, :2]
    a = axes.T @ np.array([wall["ax"] - ego["x"], wall["ay"] - ego["y"]])
    b = axes.T @ np.array([wall["bx"] - ego["x"], wall["by"] - ego["y"]])
    edge = b - a
    system = np.array([[ray[0], -edge[0]], [ray[1], -edge[1]]])
    if abs(np.linalg.det(system)) < 1e-12:
        return math.inf
    distance, share = np.linalg.solve(system, a - start[:2])
    up = start[2] + distance * ray[2]
    beyond = margin / np.hypot(*edge)
    inside = -beyond <= share <= 1.0 + beyond and -margin <= up <= wall["height"] + margin
    return float(distance) if distance >= 0.0 and inside else math.inf


def trace(
    rows: NDArray[np.void],
    row: int,
    walls: NDArray[np.void],
    start: Vector,
    ray: Vector,
    reach: float,
    margin: float = 0.0,
) -> Echo:
    """Return the first object that a ray hits within `reach`, or else the ground."""
    ego = rows[row]
    found = [
        Echo(ray_to_body(start, ray, ego, body, margin), ("body", int(body["id"])))
        for body in seen_bodies(rows, row)
    ]
    found += [
        Echo(ray_to_wall(start, ray, ego, wall, margin), ("wall", int(wall["building"])))
        for wall in walls
    ]
    nearest = min(found, key=lambda echo: (echo.distance, echo.what), default=Echo(math.inf))
    if nearest.distance < reach:
        return nearest
    if start[2] < reach * -ray[2]:
        return Echo(-start[2] / ray[2], ("ground", 0))
    return Echo(reach)


def fan_rays(axes: Vector, azimuths: Vector, elevations: Vector) -> Vector:
    """Return the directions (azimuths, elevations, 3) of a fan of rays in the vehicle's frame."""
    return np.array(
        [
            [
                axes @ np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])
                for e in elevations
            ]
            for a in azimuths
        ]
    )


def pixel_ray(axes: Vector, width: int, height: int, fov: float, row: int, column: int) -> Vector:
    """Return the ray of a pixel in the frame of the vehicle, with a length of 1 m in depth."""
    focal = 0.5 * width / math.tan(0.5 * fov)
    right = (column + 0.5 - 0.5 * width) / focal
    down = (row + 0.5 - 0.5 * height) / focal
    ray: Vector = axes @ np.array([1.0, -right, -down])
    return ray


def covers(body: np.void, x: float, y: float, margin: float) -> bool:
    """Return whether a point in world coordinates is under a body."""
    dx, dy = x - body["x"], y - body["y"]
    along = dx * math.cos(body["heading"]) + dy * math.sin(body["heading"])
    across = dy * math.cos(body["heading"]) - dx * math.sin(body["heading"])
    return bool(
        abs(along) <= 0.5 * body["length"] + margin and abs(across) <= 0.5 * body["width"] + margin
    )
