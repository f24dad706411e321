"""The nearest road points by sorting all of them."""

from __future__ import annotations

import math

from cavmarl.sensors.kernels.nearest_road_points import RoadPoints


def nearest_points(
    road_map: RoadPoints, x: float, y: float, z: float, range_m: float, count: int
) -> list[int]:
    """Indices by distance, then by index."""
    near = []
    for index, point in enumerate(road_map.points):
        squared = (point["x"] - x) * (point["x"] - x) + (point["y"] - y) * (point["y"] - y)
        if squared <= range_m * range_m and abs(point["z"] - z) <= 4.0:
            near.append((squared, index))
    return [index for _, index in sorted(near)[:count]]


def in_ego_frame(
    point: tuple[float, float], place: tuple[float, float], heading: float
) -> tuple[float, float]:
    """Forward and left of a point, by its polar angle."""
    dx, dy = point[0] - place[0], point[1] - place[1]
    distance, angle = math.hypot(dx, dy), math.atan2(dy, dx) - heading
    return distance * math.cos(angle), distance * math.sin(angle)
