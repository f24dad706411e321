"""Reads terrain models as tiles of a grid: GeoTIFF with Pillow, and HGT of SRTM.

netconvert's reader is not used, because its build for Python refuses HGT, assumes degrees and
metres in every GeoTIFF, does not handle voids, and changes the network.
"""

from __future__ import annotations

import gzip
import io
import math
import re
import warnings
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError, require

Grid = NDArray[np.float64]

WGS84 = "EPSG:4326"
_FORMATS = "give a GeoTIFF (.tif), or an SRTM tile (.hgt, .hgt.zip, .hgt.gz)"
_HGT = re.compile(r"([NS])(\d{2})([EW])(\d{3})", re.IGNORECASE)
_HGT_VOID = -32768
_LOWEST_M, _HIGHEST_M = -500.0, 9000.0  # range of heights on the earth; other values are voids
_MOST_BYTES = 1 << 30
_FEET = {9002: "feet", 9003: "US feet", 9005: "feet", 9006: "feet"}  # EPSG's units of length
_USER_DEFINED = 32767
# Tags of TIFF
_SCALE, _TIE_POINTS, _MATRIX, _GEO_KEYS, _NO_DATA, _BANDS = 33550, 33922, 34264, 34735, 42113, 277
# Keys of GeoTIFF
_RASTER_TYPE, _GEOGRAPHIC, _PROJECTED, _VERTICAL, _VERTICAL_UNIT = 1025, 2048, 3072, 4096, 4099
_LINEAR_UNIT = 3076


@dataclass(frozen=True)
class HeightTile:
    """Heights on a grid: cell (row, column) is at x0 + column · dx, y0 + row · dy."""

    name: str
    crs: str  # EPSG code of the coordinate system of x and y
    # (rows, columns) m above the model's own zero; NaN: unknown
    heights_m: Grid
    x0: float
    y0: float
    dx: float
    dy: float  # negative if the first row is the northern one

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Min x, min y, max x, max y of the cells, in the unit of `crs`."""
        rows, columns = self.heights_m.shape
        x = sorted((self.x0 - self.dx / 2, self.x0 + (columns - 0.5) * self.dx))
        y = sorted((self.y0 - self.dy / 2, self.y0 + (rows - 0.5) * self.dy))
        return x[0], y[0], x[1], y[1]


def read_tile(path: Path) -> HeightTile:
    """Read one file of heights.

    Raises:
        MapError: the file cannot be read, is truncated or of another kind, has no projection, or
            its heights are not in metres.
        MissingExtraError: the file is a GeoTIFF, and Pillow is not installed.
    """
    try:
        content = path.read_bytes()
        if path.suffix.lower() in (".zip", ".gz"):
            content = _unpacked(path, content)
    except (OSError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise MapError(f"{path}: cannot be read ({error})") from error
    if content[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _geotiff(path, content)
    if ".hgt" in path.name.lower():
        return _hgt(path, content)
    raise MapError(f"{path}: not a file of heights: {_FORMATS}")


def _unpacked(path: Path, content: bytes) -> bytes:
    if path.suffix.lower() == ".gz":
        stream: Any = gzip.GzipFile(fileobj=io.BytesIO(content))
    else:
        packed = zipfile.ZipFile(io.BytesIO(content))
        names = [name for name in packed.namelist() if name.lower().endswith((".hgt", ".tif"))]
        if len(names) != 1:
            raise MapError(f"{path}: has {len(names)} files of heights: give them one by one")
        stream = packed.open(names[0])
    unpacked: bytes = stream.read(_MOST_BYTES + 1)
    if len(unpacked) > _MOST_BYTES:
        raise MapError(f"{path}: is larger than {_MOST_BYTES} bytes: cut it first")
    return unpacked


def _hgt(path: Path, content: bytes) -> HeightTile:
    named = _HGT.match(path.name)
    if named is None:
        raise MapError(
            f"{path}: the name of an SRTM tile must give its position, like N43E007.hgt: rename it"
        )
    side = math.isqrt(len(content) // 2)
    if side * side * 2 != len(content) or side < 2:
        raise MapError(
            f"{path}: {len(content)} bytes are not a square of 16-bit heights (1201² or 3601²): "
            "the file is truncated: download it again"
        )
    north = int(named[2]) * (1 if named[1].upper() == "N" else -1)
    east = int(named[4]) * (1 if named[3].upper() == "E" else -1)
    raw = np.frombuffer(content, ">i2").reshape(side, side)
    step = 1.0 / (side - 1)
    return HeightTile(path.name, WGS84, _cleaned(raw, _HGT_VOID), east, north + 1.0, step, -step)


def _geotiff(path: Path, content: bytes) -> HeightTile:
    image_module = require("PIL.Image", "maps")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of large images; _MOST_BYTES limits them
            with image_module.open(io.BytesIO(content)) as image:
                tags = dict(image.tag_v2)
                raw = np.asarray(image)
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, EOFError) as error:
        raise MapError(
            f"{path}: cannot be read as a GeoTIFF ({error}): the file is truncated or of another "
            "kind: download it again, or convert it (gdal_translate -ot Float32)"
        ) from error
    except image_module.DecompressionBombError as error:
        raise MapError(f"{path}: {error}: cut the model to the map (gdalwarp -te)") from error
    if raw.ndim != 2 or tags.get(_BANDS, 1) != 1 or raw.dtype == np.uint8:
        raise MapError(
            f"{path}: is a picture, not one band of heights: give a digital elevation model"
        )
    keys = _geo_keys(tags)
    _check_metres(path, keys)
    x0, y0, dx, dy = _placed(path, tags)
    if keys.get(_RASTER_TYPE, 1) != 2:  # the tie point is the corner of a cell, not its centre
        x0, y0 = x0 + dx / 2, y0 + dy / 2
    void = str(tags.get(_NO_DATA, "")).strip("\0 ")
    try:
        no_data = float(void) if void else None
    except ValueError as error:
        raise MapError(
            f"{path}: the value of voids, '{void}', is not a number: repair the file"
        ) from error
    return HeightTile(path.name, _crs(path, keys), _cleaned(raw, no_data), x0, y0, dx, dy)


def _cleaned(raw: NDArray[Any], void: float | None) -> Grid:
    heights: Grid = raw.astype(np.float64)
    unknown = ~np.isfinite(heights) | (heights < _LOWEST_M) | (heights > _HIGHEST_M)
    if void is not None and math.isfinite(void):
        unknown |= heights == np.float64(raw.dtype.type(void) if raw.dtype.kind == "f" else void)
    heights[unknown] = np.nan
    return heights


def _geo_keys(tags: dict[int, Any]) -> dict[int, int]:
    """Return the keys of GeoTIFF whose value is a number in the key directory."""
    words = tuple(tags.get(_GEO_KEYS, ()))
    rows = [words[first : first + 4] for first in range(4, len(words) - 3, 4)]
    return {int(key): int(value) for key, place, _, value in rows if place == 0}


def _check_metres(path: Path, keys: dict[int, int]) -> None:
    unit = keys.get(_VERTICAL_UNIT)
    if unit is None and keys.get(_LINEAR_UNIT) in _FEET and _VERTICAL not in keys:
        unit = keys[_LINEAR_UNIT]
    feet = _FEET.get(unit or 0)
    if unit is None and _LINEAR_UNIT not in keys and _VERTICAL not in keys:
        feet = _feet_of(keys.get(_PROJECTED, 0))
    if feet is not None:
        raise MapError(
            f"{path}: its heights are in {feet}: convert them to metres (gdal_calc.py "
            "--calc 'A*0.3048', then gdal_edit.py with a CRS in metres)"
        )


def _feet_of(projected: int) -> str | None:
    """Return the name of a projection's unit if it is a kind of foot; None: metres, or unknown."""
    if projected in (0, _USER_DEFINED):
        return None
    pyproj: Any = require("pyproj", "maps")
    try:
        unit = str(pyproj.CRS.from_epsg(projected).axis_info[0].unit_name)
    except (pyproj.exceptions.CRSError, IndexError):
        return None
    return "feet" if "foot" in unit else None


def _placed(path: Path, tags: dict[int, Any]) -> tuple[float, float, float, float]:
    """Return x and y of the first cell's corner (or centre), and the steps between cells."""
    tie, scale, matrix = tags.get(_TIE_POINTS), tags.get(_SCALE), tags.get(_MATRIX)
    if matrix is not None and len(matrix) == 16 and matrix[1] == matrix[4] == 0.0:
        place = (matrix[3], matrix[7], matrix[0], matrix[5])
    elif tie is not None and scale is not None and len(tie) == 6:
        dx, dy = scale[0], -scale[1]
        place = (tie[3] - tie[0] * dx, tie[4] - tie[1] * dy, dx, dy)
    else:
        raise MapError(f"{path}: has no position, or is rotated: warp it (gdalwarp -t_srs {WGS84})")
    if not (all(map(math.isfinite, place)) and place[2] != 0.0 and place[3] != 0.0):
        raise MapError(f"{path}: its position is {place}: repair it (gdal_edit.py)")
    return float(place[0]), float(place[1]), float(place[2]), float(place[3])


def _crs(path: Path, keys: dict[int, int]) -> str:
    code = keys.get(_PROJECTED, keys.get(_GEOGRAPHIC, 0))
    if code in (0, _USER_DEFINED):
        raise MapError(
            f"{path}: has no projection with an EPSG code: warp it (gdalwarp -t_srs {WGS84}), or "
            "set it (gdal_edit.py -a_srs EPSG:…)"
        )
    return f"EPSG:{code}"
