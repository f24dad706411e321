"""Longitudes and latitudes as places of a map, as the map says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError, require
from cavmarl.roads.network import GeoReference

Places = NDArray[np.float64]


def project(source: Path | str, degrees: Places, geo: GeoReference) -> Places:
    """X and y in m (n, 2) of longitudes and latitudes (n, 2).

    Raises:
        MapError: one cannot be projected; `source` names where it is from.
        MissingExtraError: pyproj is not installed.
    """
    pyproj: Any = require("pyproj", "maps")
    x, y = pyproj.Proj(projparams=geo.projection)(degrees[:, 0], degrees[:, 1])
    placed: Places = np.stack([x + geo.offset_x_m, y + geo.offset_y_m], axis=1)
    if not np.isfinite(placed).all():
        lost = int(np.flatnonzero(~np.isfinite(placed).all(axis=1))[0])
        raise MapError(
            f"{source}: longitude {degrees[lost, 0]:g}, latitude {degrees[lost, 1]:g} cannot be "
            "projected as the map is: export the file again for this map"
        )
    return placed


def unproject(places: Places, geo: GeoReference) -> Places:
    """Longitudes and latitudes (n, 2) of x and y in m (n, 2).

    Raises MissingExtraError: pyproj is not installed.
    """
    pyproj: Any = require("pyproj", "maps")
    east, north = places[:, 0] - geo.offset_x_m, places[:, 1] - geo.offset_y_m
    return np.stack(pyproj.Proj(projparams=geo.projection)(east, north, inverse=True), axis=1)
