"""Exports of the distance of each point (csv, ply), and a page with a picture that rotates."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.maps.fidelity.comparison import PAPER_TABLE, Comparison

_PAGE = Path(__file__).with_name("page.html")
_SHOWN = 60_000  # points of each cloud on the page
_FAR_M = 1.0  # points at this distance or farther are red
_VERTEX = np.dtype(
    [
        *((axis, "<f8") for axis in "xyz"),
        ("distance_m", "<f4"),
        *((color, "u1") for color in ("red", "green", "blue")),
    ]
)


def colors_of(distance_m: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return colours (n, 3): from blue at 0 m via green and yellow to red from `_FAR_M` on."""
    share = np.clip(distance_m / _FAR_M, 0.0, 1.0)
    stops = np.array([0.0, 0.33, 0.66, 1.0])
    table = np.array([(40, 80, 220), (40, 180, 90), (245, 200, 40), (220, 40, 40)])
    found = [np.interp(share, stops, table[:, column]) for column in range(3)]
    return np.stack(found, axis=1).astype(np.uint8)


def write_points(path: Path, comparison: Comparison) -> None:
    """Write each point of P after the transform, with its distance: csv, or ply with colours."""
    if path.suffix.lower() not in (".csv", ".ply"):
        raise ConfigError(f"{path}: the name must end in .csv or .ply")
    points, distance_m = comparison.aligned, comparison.distance_m
    try:
        if path.suffix.lower() == ".csv":
            np.savetxt(
                path,
                np.column_stack([points, distance_m]),
                fmt="%.4f",
                delimiter=",",
                header="x,y,z,distance_m",
                comments="",
            )
            return
        rows = np.zeros(len(points), _VERTEX)
        rows["x"], rows["y"], rows["z"] = points.T
        rows["distance_m"] = distance_m
        rows["red"], rows["green"], rows["blue"] = colors_of(distance_m).T
        head = "ply\nformat binary_little_endian 1.0\n" + f"element vertex {len(rows)}\n"
        head += (
            "".join(f"property double {axis}\n" for axis in "xyz") + "property float distance_m\n"
        )
        head += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
        path.write_bytes((head + "end_header\n").encode() + rows.tobytes())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def write_page(path: Path, comparisons: Sequence[Comparison]) -> None:
    """Write a page with the table, the histograms, and clouds that can be rotated by the mouse."""
    middle = comparisons[0].reference.points.mean(axis=0)
    scenes = []
    for comparison in comparisons:
        laid = _some(comparison.aligned - middle)
        ground = _some(comparison.reference.points - middle)
        scenes.append(
            {
                "title": f"{comparison.source.name} → {comparison.reference.name}",
                "points": _packed(comparison.aligned[laid] - middle),
                "colors": base64.b64encode(
                    colors_of(comparison.distance_m[laid]).tobytes()
                ).decode(),
                "reference": _packed(comparison.reference.points[ground] - middle),
                "report": comparison.to_dict(),
            }
        )
    document = json.dumps({"scenes": scenes, "paper": PAPER_TABLE}).replace("<", "\\u003c")
    title = html.escape(comparisons[0].reference.name)
    page = _PAGE.read_text(encoding="utf-8").replace("@TITLE@", title)
    try:
        path.write_text(page.replace("@DATA@", document), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def _some(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the rows of at most `_SHOWN` points, evenly spaced."""
    return np.linspace(0, len(points) - 1, min(len(points), _SHOWN)).astype(np.int64)


def _packed(points: NDArray[np.float64]) -> str:
    return base64.b64encode(points.astype("<f4").tobytes()).decode()
