"""Draw the data of one vehicle's sensors, for the pages about sensors.

`python -m docs.pictures.sensor_pictures docs/images` draws it again.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.engine.world_setup import load_world
from cavmarl.render.canvas import load_pygame
from cavmarl.sensors.kernels.camera_picture import colours
from cavmarl.sensors.kernels.panorama import LANE_LINE
from cavmarl.sensors.mounted.frames import Frames
from docs.pictures.pictures import moment

__all__ = ["sensor_sheet", "write_sensor_sheet"]

ENV = "grid4x4"
BUILDINGS = "map/buildings.poly.xml"
TIME_S = 18.0
AGENT = 3
SIZE = {"width": 480, "height": 270}
RIG: dict[str, dict[str, Any]] = {
    "colours": {"type": "rgb_camera", "x_m": 0.6, "z_m": 1.5, **SIZE},
    "classes": {"type": "semantic_camera", "x_m": 0.6, "z_m": 1.5, **SIZE},
    "depths": {"type": "depth_camera", "x_m": 0.6, "z_m": 1.5, **SIZE},
    "grid": {"type": "bev_grid", "cell_m": 0.25},
    "lidar": {"type": "lidar", "z_m": 1.6, "layers": 32, "rays": 720, "lower_deg": -20.0},
}
MARGIN = 6
LIDAR_M = 32.0  # distance from the middle of its picture to the edge

Image = NDArray[np.uint8]


def sensor_sheet() -> Image:
    """Return (H, W, 3): colours and classes, depths and lidar from above, the grid beside them."""
    overrides = {
        "rig": {name: {**sensor, "rate_hz": 5} for name, sensor in RIG.items()},
        "map.buildings": BUILDINGS,
    }
    frames = moment(load_world(ENV, background=80, overrides=overrides), TIME_S).frames
    left = np.concatenate([_colours(frames), _gap(SIZE["width"], MARGIN), _depths(frames)])
    middle = np.concatenate([_classes(frames), _gap(SIZE["width"], MARGIN), _points(frames)])
    tall = left.shape[0]
    return np.concatenate(
        [left, _gap(MARGIN, tall), middle, _gap(MARGIN, tall), _grid(frames, tall)], axis=1
    )


def write_sensor_sheet(folder: Path) -> Path:
    """Write the picture as `sensors.png` into a folder."""
    pygame = load_pygame()
    path = folder / "sensors.png"
    surface = pygame.surfarray.make_surface(sensor_sheet().swapaxes(0, 1))
    pygame.image.save(surface, str(path))
    return path


def _latest(frames: Frames, name: str) -> NDArray[Any]:
    newest: NDArray[Any] = frames[name].data[0, AGENT, -1]
    return newest


def _gap(width: int, height: int) -> Image:
    return np.full((height, width, 3), 255, np.uint8)


def _colours(frames: Frames) -> Image:
    return _latest(frames, "colours")


def _palette() -> Image:
    palette = colours()
    palette[LANE_LINE] = 255
    return palette.astype(np.uint8)


def _classes(frames: Frames) -> Image:
    image: Image = _palette()[_latest(frames, "classes")]
    return image


def _depths(frames: Frames) -> Image:
    """Return depths as grey: near is dark; the scale is logarithmic."""
    depths = _latest(frames, "depths").astype(np.float64)
    shade = np.log(np.maximum(depths, 1.0)) / np.log(100.0)
    return np.repeat((255 * np.clip(shade, 0, 1)).astype(np.uint8)[..., np.newaxis], 3, axis=2)


def _points(frames: Frames) -> Image:
    """Return the lidar's points from above, forward up; higher points are lighter."""
    distances = _latest(frames, "lidar")
    layers, rays = distances.shape
    elevation = np.radians(np.linspace(-20.0, 5.0, layers))[:, np.newaxis]
    azimuth = 2.0 * np.pi * np.arange(rays) / rays
    height, width = SIZE["height"], SIZE["width"]
    scale = height / (2.0 * LIDAR_M)
    flat = distances * np.cos(elevation)
    up = 1.6 + distances * np.sin(elevation)
    row = (0.5 * height - flat * np.cos(azimuth) * scale).astype(int)
    column = (0.5 * width - flat * np.sin(azimuth) * scale).astype(int)
    shown = (distances < 60.0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    image = np.full((height, width, 3), 24, np.uint8)
    light = np.clip(0.35 + 0.2 * up, 0.0, 1.0)[..., np.newaxis] * [140.0, 220.0, 255.0]
    image[row[shown], column[shown]] = light[shown].astype(np.uint8)
    return image


def _grid(frames: Frames, tall: int) -> Image:
    """Return the grid with the height of the pictures beside it."""
    cells = _palette()[_latest(frames, "grid")]
    rows = np.arange(tall) * cells.shape[0] // tall
    columns = np.arange(tall * cells.shape[1] // cells.shape[0]) * cells.shape[0] // tall
    image: Image = cells[rows][:, columns]
    return image


if __name__ == "__main__":
    print(write_sensor_sheet(Path(sys.argv[1])))
