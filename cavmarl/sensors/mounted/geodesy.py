"""Conversion between map coordinates and WGS 84: latitude and longitude in degrees, height in m.

If the map states its projection, this projection is used. Otherwise the map is assumed to lie in
the plane that touches the ellipsoid at an origin. z is the height above the origin.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.rig import GnssConfig
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.elementary_arrays import atan2_all, cos_all, hypot_all, sin_all
from cavmarl.maps.projection import projection_of
from cavmarl.roads.network import GeoReference, RoadNetwork

Points = NDArray[np.float64]

# WGS 84: semi-major axis in m, flattening, and the square of the first eccentricity.
_AXIS_M = 6_378_137.0
_FLATTENING = 1.0 / 298.257223563
_SQUARED_ECCENTRICITY = _FLATTENING * (2.0 - _FLATTENING)
_ROUNDS = 6  # fixed-point iterations for the latitude; each adds at least two digits


class Geodesy(Protocol):
    """The position of a map on the earth."""

    def to_earth(self, points: Points) -> Points:
        """Convert map coordinates x, y, z (n, 3) to latitude, longitude, height (n, 3)."""
        ...

    def to_map(self, places: Points) -> Points:
        """Convert latitude, longitude, height (n, 3) to map coordinates x, y, z (n, 3)."""
        ...


def geodesy_of(network: RoadNetwork, config: GnssConfig) -> Geodesy:
    """Return the map's own projection, or else a tangent plane at the sensor's configured origin.

    Raises MissingExtraError: the map is projected, and pyproj is not installed; MapError: PROJ does
    not know the projection.
    """
    if network.geo is not None:
        return ProjectedMap(network.geo, config.origin_height_m)
    return TangentPlane(config.origin_lat_deg, config.origin_lon_deg, config.origin_height_m)


class ProjectedMap:
    """A map with a projection.

    `geo`: the projection. `height_m`: height of z = 0 above the ellipsoid.
    """

    def __init__(self, geo: GeoReference, height_m: float) -> None:
        self._project = projection_of(geo)
        self._offset_m = np.array([geo.offset_x_m, geo.offset_y_m, -height_m])

    def to_earth(self, points: Points) -> Points:
        x, y, height_m = (points - self._offset_m).T
        longitude, latitude = self._project(x, y, inverse=True)
        return np.stack([latitude, longitude, height_m], axis=1)

    def to_map(self, places: Points) -> Points:
        latitude, longitude, height_m = places.T
        x, y = self._project(longitude, latitude)
        found: Points = np.stack([x, y, height_m], axis=1) + self._offset_m
        return found


class TangentPlane:
    """A map in the plane that touches the ellipsoid at an origin, x east and y north.

    The conversion uses earth-centred coordinates (Hofmann-Wellenhof, Lichtenegger, Wasle: "GNSS",
    2008, chapter 8).

    `latitude_deg`, `longitude_deg`: position of the map's (0, 0). `height_m`: height of z = 0
    there, above the ellipsoid.
    """

    def __init__(self, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
        origin = np.array([[latitude_deg, longitude_deg, height_m]])
        self._origin_m = _to_centred(origin)
        sin_lat, cos_lat = _sin_cos(latitude_deg)
        sin_lon, cos_lon = _sin_cos(longitude_deg)
        self._axes = np.array(
            [
                [-sin_lon, cos_lon, 0.0],
                [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
                [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
            ]
        )

    def to_earth(self, points: Points) -> Points:
        return _from_centred(_turned(points, self._axes) + self._origin_m)

    def to_map(self, places: Points) -> Points:
        return _turned(_to_centred(places) - self._origin_m, self._axes.T)


def _turned(points: Points, axes: Points) -> Points:
    """Return points (n, 3) times axes (3, 3), without BLAS, whose sums depend on the processor."""
    found: Points = points[:, :1] * axes[0] + points[:, 1:2] * axes[1] + points[:, 2:] * axes[2]
    return found


def _sin_cos(angle_deg: float) -> tuple[float, float]:
    cos, sin = cos_sin(math.radians(angle_deg))
    return sin, cos


def _to_centred(places: Points) -> Points:
    """Convert latitude, longitude, height (n, 3) to earth-centred x, y, z (n, 3) in m."""
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    height_m = places[:, 2]
    normal_m = _normal_m(latitude)
    across_m = (normal_m + height_m) * cos_all(latitude)
    polar_m = (normal_m * (1.0 - _SQUARED_ECCENTRICITY) + height_m) * sin_all(latitude)
    return np.stack([across_m * cos_all(longitude), across_m * sin_all(longitude), polar_m], axis=1)


def _from_centred(points: Points) -> Points:
    """Invert `_to_centred`, for points away from the poles."""
    x, y, polar_m = points.T
    across_m = hypot_all(x, y)
    latitude = atan2_all(polar_m, across_m * (1.0 - _SQUARED_ECCENTRICITY))
    for _ in range(_ROUNDS):
        raised_m = polar_m + _SQUARED_ECCENTRICITY * _normal_m(latitude) * sin_all(latitude)
        latitude = atan2_all(raised_m, across_m)
    height_m = across_m / cos_all(latitude) - _normal_m(latitude)
    return np.stack([np.degrees(latitude), np.degrees(atan2_all(y, x)), height_m], axis=1)


def _normal_m(latitude: Points) -> Points:
    found: Points = _AXIS_M / np.sqrt(1.0 - _SQUARED_ECCENTRICITY * np.square(sin_all(latitude)))
    return found
