"""Latitudes and longitudes of places, as each version of the client computes them.

All versions treat the earth as a sphere. Client 0.9.16 uses a transverse Mercator projection with a
scale of 0.9996, and its latitude increases to the south. Other versions use a Mercator projection.
"""

from __future__ import annotations

import math

_RADIUS_M = 6378137.0
_SCALE = 0.9996


def geolocation(
    origin: tuple[float, float], x: float, y: float, is_mercator: bool
) -> tuple[float, float]:
    """Return latitude and longitude in degrees of a place in CARLA's frame.

    Args:
        origin: latitude and longitude of (0, 0), in degrees.
        x: m to the east.
        y: m to the south.
        is_mercator: see `carla_versions.ClientVersion`.
    """
    latitude, longitude = map(math.radians, origin)
    if is_mercator:
        size_m = _RADIUS_M * math.cos(latitude)
        north = math.log(math.tan(0.25 * math.pi + 0.5 * latitude)) - y / size_m
        found = 2.0 * math.atan(math.exp(north)) - 0.5 * math.pi, longitude + x / size_m
    else:
        along, across = latitude + y / (_RADIUS_M * _SCALE), x / (_RADIUS_M * _SCALE)
        found = (
            math.asin(math.sin(along) / math.cosh(across)),
            longitude + math.atan2(math.sinh(across), math.cos(along)),
        )
    return math.degrees(found[0]), math.degrees(found[1])
