"""Generated terrain models as GeoTIFF and HGT files, and a town of OpenStreetMap."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, TiffImagePlugin

WEST, SOUTH = 11.0, 48.0  # longitude and latitude of the town in degrees
M_PER_DEG = 111_195.0  # approximate length of a degree of latitude

Ground = Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]

# Two roads of 1 km cross each other. The second road crosses a third one on a bridge.
TOWN = """<osm version="0.6">
  <node id="1" lat="48.000" lon="11.000"/><node id="2" lat="48.004" lon="11.000"/>
  <node id="3" lat="48.009" lon="11.000"/><node id="4" lat="48.004" lon="11.005"/>
  <node id="5" lat="48.004" lon="11.0055"/><node id="6" lat="48.004" lon="11.013"/>
  <node id="7" lat="48.000" lon="11.00525"/><node id="8" lat="48.009" lon="11.00525"/>
  <way id="10"><nd ref="1"/><nd ref="2"/><nd ref="3"/>TAGS</way>
  <way id="11"><nd ref="2"/><nd ref="4"/>TAGS</way>
  <way id="12"><nd ref="4"/><nd ref="5"/>TAGS<tag k="bridge" v="yes"/><tag k="layer" v="1"/></way>
  <way id="13"><nd ref="5"/><nd ref="6"/>TAGS</way>
  <way id="14"><nd ref="7"/><nd ref="8"/>TAGS</way>
  <way id="15"><nd ref="1"/><nd ref="7"/>TAGS</way>
</osm>
""".replace("TAGS", '<tag k="highway" v="residential"/><tag k="name" v="Hill Road"/>')


def plane(east: float, north: float, base: float = 500.0) -> Ground:
    """Return the height of a plane with these slopes (ratios) to the east and to the north."""
    scale = M_PER_DEG * np.cos(np.radians(SOUTH))

    def height(lon: NDArray[Any], lat: NDArray[Any]) -> NDArray[Any]:
        return base + east * scale * (lon - WEST) + north * M_PER_DEG * (lat - SOUTH)

    return height


def write_geotiff(
    path: Path,
    ground: Ground,
    box: tuple[float, float, float, float] = (10.995, 47.995, 11.02, 48.015),
    step: float = 0.0002,
    *,
    kind: Any = np.float32,
    keys: tuple[int, ...] = (1024, 0, 1, 2, 1025, 0, 1, 2, 2048, 0, 1, 4326),
    holes: Callable[[NDArray[Any]], None] = lambda heights: None,
) -> Path:
    """Write a GeoTIFF with the height at the middle of each cell; -9999 marks voids."""
    west, south, east, north = box
    lon = np.arange(west, east + step / 2, step)
    lat = np.arange(north, south - step / 2, -step)
    heights = ground(*np.meshgrid(lon, lat)).astype(np.float64)
    holes(heights)
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[33550] = (step, step, 0.0)
    tags[33922] = (0.0, 0.0, 0.0, west, north, 0.0)
    tags.tagtype[33550] = tags.tagtype[33922] = 12
    if keys:
        tags[34735] = (1, 1, 0, len(keys) // 4, *keys)
        tags.tagtype[34735] = 3
    tags[42113] = "-9999"
    Image.fromarray(np.nan_to_num(heights, nan=-9999).astype(kind)).save(path, tiffinfo=tags)
    return path


def write_hgt(path: Path, ground: Ground) -> Path:
    """Write the SRTM tile N48E011 with 1201 by 1201 heights."""
    lon = np.linspace(11.0, 12.0, 1201)
    lat = np.linspace(49.0, 48.0, 1201)
    path.write_bytes(np.round(ground(*np.meshgrid(lon, lat))).astype(">i2").tobytes())
    return path
