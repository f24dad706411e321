"""Reads point clouds from files: csv and other text, ply, pcd, las and laz.

Formats are recognized by the first bytes of a file, text by its suffix. Points with NaN or infinite
coordinates are left out and counted.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError, MapError, require

Points = NDArray[np.float64]

CLOUD_ENDINGS = (".csv", ".txt", ".xyz", ".ply", ".pcd", ".las", ".laz")
MOST_POINTS = 50_000_000  # 1.2 GB after reading, several times that during a comparison
_MOST_DIGITS = 18  # maximum number of digits of the number of points
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_WORDS = re.compile(r"[,;\s]+")


@dataclass(frozen=True)
class Cloud:
    """Points in one frame."""

    name: str
    points: Points  # (n, 3) x, y, z in m
    # "read": number of points in the file; then, by name of filter: how many points it removed
    counts: dict[str, int] = field(default_factory=dict)

    def kept(self, points: Points, filter_name: str) -> Cloud:
        """Return the cloud with only some points, and add the filter's count of removed points."""
        removed = self.counts.get(filter_name, 0) + len(self.points) - len(points)
        return Cloud(self.name, points, self.counts | {filter_name: removed})


def is_cloud(path: Path) -> bool:
    return path.suffix.lower() in CLOUD_ENDINGS


def read_cloud(path: Path) -> Cloud:
    """Return the points of a file, in the file's frame and unit.

    The scale and offset in the header of a las file are applied.

    Raises:
        MapError: the file is missing, truncated, of another kind, or has no valid point.
        CapacityError: it has more points than `MOST_POINTS`.
        MissingExtraError: pcd, las and laz need the extra `maps`.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(64)
            stream.seek(0)
            found = _read(path, head, stream)
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise MapError(f"{path}: not a text file: {_known()}") from error
    sound = np.isfinite(found).all(axis=1)
    cloud = Cloud(path.name, found, {"read": len(found)}).kept(found[sound], "no numbers")
    if not len(cloud.points):
        why = "has no points" if not len(found) else f"all {len(found)} points are NaN or infinite"
        raise MapError(f"{path}: {why}: export it again")
    return cloud


def write_cloud(path: Path, cloud: Cloud) -> None:
    """Write points as csv or ply, in the form that `read_cloud` reads.

    Raises MapError: the suffix is unknown, or the file cannot be written.
    """
    if path.suffix.lower() not in (".csv", ".ply"):
        raise MapError(f"{path}: the name must end in .csv or .ply")
    try:
        if path.suffix.lower() == ".csv":
            head = "x,y,z"
            np.savetxt(path, cloud.points, "%.4f", delimiter=",", header=head, comments="")
            return
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud.points)}\n"
        head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        path.write_bytes(head.encode() + cloud.points.astype("<f8").tobytes())
    except OSError as error:
        raise MapError(f"{path}: cannot be written ({error.strerror or error})") from error


def _known() -> str:
    return f"give a point cloud ({', '.join(CLOUD_ENDINGS)})"


def _read(path: Path, head: bytes, stream: BinaryIO) -> Points:
    if head.startswith(b"ply"):
        return _read_ply(path, stream)
    if head.startswith(b"LASF"):
        return _read_las(path)
    if b"PCD" in head or head.startswith(b"VERSION"):
        return _read_pcd(path, stream.read(4096))
    if path.suffix.lower() in (".csv", ".txt", ".xyz"):
        return _read_text(path, stream)
    raise MapError(f"{path}: its content does not match '{path.suffix}': {_known()}")


def _check_number(path: Path, number: int) -> None:
    if number > MOST_POINTS:
        raise CapacityError(
            f"{path}: has {number} points, more than {MOST_POINTS}: thin it out or crop it first"
        )


def _read_text(path: Path, stream: BinaryIO) -> Points:
    number, first, head = 0, 0, ""
    for line in stream:
        number += 1
        if not head and line.strip() and not line.startswith((b"#", b"//")):
            first, head = number, line.decode("utf-8-sig").strip()
    _check_number(path, number)
    words = [word.strip('"').lower() for word in _WORDS.split(head)]
    columns: tuple[int, ...] = (0, 1, 2)
    skipped = first - 1
    if head and not _is_number(words[0]):
        if not {"x", "y", "z"} <= set(words):
            raise MapError(
                f"{path}, line {first}: the header has no columns x, y and z: rename the columns"
            )
        columns = tuple(words.index(axis) for axis in "xyz")
        skipped = first
    if not head or number == skipped:
        return np.zeros((0, 3))
    stream.seek(0)
    rows = (line.replace(b";", b" ").replace(b",", b" ") for line in stream)
    try:
        found = np.loadtxt(
            rows, skiprows=skipped, usecols=columns, ndmin=2, comments=("#", "//"), encoding="utf-8"
        )
    except ValueError as error:
        raise MapError(
            f"{path}, after line {skipped}: {error}: each row needs three numbers x, y, z"
        ) from error
    return np.asarray(found, dtype=np.float64).reshape(-1, 3)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read_ply(path: Path, stream: BinaryIO) -> Points:
    """Read the `vertex` element, which must come first."""
    order, number, properties = _ply_head(path, stream)
    _check_number(path, number)
    names = [name for name, _ in properties]
    if number == 0:
        return np.zeros((0, 3))
    if len(set(names)) < len(names):
        raise MapError(f"{path}: two vertex properties have the same name: export it again")
    if not {"x", "y", "z"} <= set(names):
        raise MapError(f"{path}: its vertices have no x, y and z: export it again")
    if order == "=":
        lines = [stream.readline() for _ in range(number)]
        if not any(line.strip() for line in lines):
            raise _cut_short(path, number, 0)
        try:
            table = np.loadtxt(lines, ndmin=2, usecols=[names.index(axis) for axis in "xyz"])
        except ValueError as error:
            raise MapError(f"{path}: broken rows ({error}): export it again") from error
        if len(table) != number:
            raise _cut_short(path, number, len(table))
        return np.asarray(table, dtype=np.float64).reshape(-1, 3)
    kind = np.dtype([(name, f"{order}{code}") for name, code in properties])
    raw = stream.read(number * kind.itemsize)
    if len(raw) < number * kind.itemsize:
        raise _cut_short(path, number, len(raw) // kind.itemsize)
    rows = np.frombuffer(raw, dtype=kind)
    return np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _ply_head(path: Path, stream: BinaryIO) -> tuple[str, int, list[tuple[str, str]]]:
    """Return the byte order, the number of vertices, and name and type of their properties."""
    order, number, element = "", -1, ""
    properties: list[tuple[str, str]] = []
    for _ in range(1000):
        words = stream.readline().decode("ascii", "replace").split()
        match words:
            case ["end_header"]:
                if order and number >= 0:
                    return order, number, properties
                break
            case ["format", form, _] if form in _PLY_ORDERS:
                order = _PLY_ORDERS[form]
            case ["element", element, text] if text.isdigit() and len(text) <= _MOST_DIGITS:
                if element != "vertex" and number < 0 and int(text):
                    raise MapError(f"{path}: '{element}' comes before its vertices: export again")
                number = int(text) if element == "vertex" else number
            case ["property", code, name] if element == "vertex" and code in _PLY_TYPES:
                properties.append((name, _PLY_TYPES[code]))
            case ["property", *_] if element == "vertex":
                raise MapError(
                    f"{path}: {' '.join(words)!r} of a vertex is not a number: export again"
                )
    raise MapError(f"{path}: its header has no format, or no number of vertices: export it again")


def _cut_short(path: Path, number: int, found: int) -> MapError:
    return MapError(
        f"{path}: is truncated: it has {found} of {number} points: copy or download it again"
    )


def _read_pcd(path: Path, head: bytes) -> Points:
    pypcd4: Any = require("pypcd4", "maps")
    match = re.search(rb"^POINTS\s+(\d+)", head, re.MULTILINE)
    number = int(match[1][:_MOST_DIGITS]) if match else -1
    _check_number(path, number)
    try:
        read = pypcd4.PointCloud.from_path(path)
        found = read.numpy(("x", "y", "z")).astype(np.float64)
    except Exception as error:  # pypcd4's errors have no common base
        raise MapError(
            f"{path}: not a complete pcd file ({type(error).__name__}: {error}): copy or export it "
            "again"
        ) from error
    if number >= 0 and len(found) != number:
        raise _cut_short(path, number, len(found))
    return np.asarray(found)


def _read_las(path: Path) -> Points:
    laspy: Any = require("laspy", "maps")
    try:
        with laspy.open(path) as reader:
            number = int(reader.header.point_count)
            _check_number(path, number)
            read = reader.read()
            found = np.asarray(read.xyz, dtype=np.float64)
    except CapacityError:
        raise
    except Exception as error:  # errors of laspy, its decoder and struct have no common base
        raise MapError(
            f"{path}: not a complete las or laz file ({type(error).__name__}: {error}): copy or "
            "export it again"
        ) from error
    if len(found) != number:
        raise _cut_short(path, number, len(found))
    return found
