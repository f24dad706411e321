"""Conversion between longitude, latitude and positions on a map, with the map's projection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError, require
from cavmarl.roads.network import GeoReference

Places = NDArray[np.float64]

_OF_HEIGHTS = ("+geoidgrids=", "+geoid_crs=", "+vunits=", "+vto_meter=")


def projection_of(geo: GeoReference) -> Any:
    """Return pyproj's projection of a map, without the vertical part, which may need extra files.

    Raises:
        MapError: PROJ does not know the projection.
        MissingExtraError: pyproj is not installed.
    """
    pyproj: Any = require("pyproj", "maps")
    words = geo.projection.split()
    in_the_plane = " ".join(word for word in words if not word.startswith(_OF_HEIGHTS))
    try:
        return pyproj.Proj(projparams=in_the_plane)
    except pyproj.exceptions.ProjError as error:
        raise MapError(f"projection {geo.projection!r}: {error}") from error


def project(source: Path | str, degrees: Places, geo: GeoReference) -> Places:
    """Return x and y in m (n, 2) of longitudes and latitudes (n, 2).

    Raises:
        MapError: a place cannot be projected (the message names the file `source`), or PROJ does
            not know the projection.
        MissingExtraError: pyproj is not installed.
    """
    x, y = projection_of(geo)(degrees[:, 0], degrees[:, 1])
    placed: Places = np.stack([x + geo.offset_x_m, y + geo.offset_y_m], axis=1)
    if not np.isfinite(placed).all():
        lost = int(np.flatnonzero(~np.isfinite(placed).all(axis=1))[0])
        raise MapError(
            f"{source}: longitude {degrees[lost, 0]:g}, latitude {degrees[lost, 1]:g} cannot be "
            "projected as in the map: export the file again for this map"
        )
    return placed


def unproject(places: Places, geo: GeoReference) -> Places:
    """Return longitudes and latitudes (n, 2) of x and y in m (n, 2).

    Raises:
        MapError: PROJ does not know the projection.
        MissingExtraError: pyproj is not installed.
    """
    east, north = places[:, 0] - geo.offset_x_m, places[:, 1] - geo.offset_y_m
    return np.stack(projection_of(geo)(east, north, inverse=True), axis=1)
