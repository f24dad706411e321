"""Depth, class and colour of the pixels of a camera's picture, as they are delivered.

All of these take some rows of a picture: those that have been taken last, the first of them being
row `first` of the whole picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.sensors.kernels.camera_picture import ROAD_FACE, SKY_FACE
from cavmarl.sensors.kernels.faces import CameraPose, PixelRows, ground_at
from cavmarl.sensors.kernels.semantics import (
    BICYCLE,
    BUILDING,
    BUS,
    CAR,
    GROUND,
    MOTORCYCLE,
    NOTHING,
    NUM_SEMANTICS,
    PEDESTRIAN,
    ROAD,
    TRAM,
    TRUCK,
)

# Nothing is nearer than this: a place inside of a body has no depth.
LEAST_DEPTH_M = 0.01

# From float32 to float16: the difference of the exponents' biases, and half of what is dropped.
_DROPPED = np.uint32(13)
_ONE = np.uint32(1)
_REBIAS = np.uint32((112 << 23) - 0xFFF)

# How much of a colour is lost in the haze at the end of the range.
HAZE = 0.6

_COLOURS = {
    NOTHING: (168, 200, 232),
    GROUND: (122, 148, 96),
    ROAD: (88, 90, 96),
    BUILDING: (196, 180, 160),
    CAR: (200, 60, 52),
    TRUCK: (216, 164, 48),
    BUS: (56, 104, 200),
    TRAM: (40, 150, 150),
    MOTORCYCLE: (136, 72, 168),
    BICYCLE: (64, 168, 88),
    PEDESTRIAN: (240, 120, 180),
}


def colours() -> NDArray[np.float64]:
    """(classes, 3) red, green and blue of each class in full light."""
    found = np.zeros((NUM_SEMANTICS, 3))
    for semantic, colour in _COLOURS.items():
        found[semantic] = colour
    return found


@kernel
def _deepen(camera: CameraPose, picture: PixelRows, first: int, rows: int) -> None:
    """Set the closeness also where there is only the ground or the sky."""
    width = picture.face.shape[1]
    constant, by_column, by_row = ground_at(camera, width, picture.height)
    nothing = 1.0 / camera.range_m
    for j in range(rows):
        closeness = picture.closeness[j]
        face = picture.face[j]
        start = constant + by_row * (first + j + 0.5) + by_column * 0.5
        for i in range(width):
            empty = start + by_column * i if face[i] != SKY_FACE else nothing
            closeness[i] = closeness[i] if face[i] > ROAD_FACE else empty


@kernel
def measure_depths(
    camera: CameraPose, picture: PixelRows, first: int, out: NDArray[np.float32]
) -> None:
    """Depths (rows, W) in metres along the optical axis, the range where nothing is.

    `camera`: that took the picture. `picture`: taken; its closeness is completed. `out`: (rows, W).
    """
    rows, width = out.shape
    _deepen(camera, picture, first, rows)
    nearest = np.float32(LEAST_DEPTH_M)
    for j in range(rows):
        for i in range(width):
            out[j, i] = max(np.float32(1.0 / picture.closeness[j, i]), nearest)


@kernel
def write_halves(bits: NDArray[np.uint32], out: NDArray[np.uint16]) -> None:
    """The bits of float16 (rows, W) from those of float32, all between 2^-14 and 65504.

    Rounded to the nearest, and of two equally near ones to the even one.
    """
    rows, width = out.shape
    for j in range(rows):
        for i in range(width):
            half = bits[j, i] - _REBIAS + ((bits[j, i] >> _DROPPED) & _ONE)
            out[j, i] = np.uint16(half >> _DROPPED)


@kernel
def write_classes(picture: PixelRows, out: NDArray[np.uint8]) -> None:
    """The class of what each pixel shows, (rows, W)."""
    rows, width = out.shape
    for j in range(rows):
        for i in range(width):
            out[j, i] = picture.semantic[picture.face[j, i]]


@kernel
def write_colours(
    camera: CameraPose,
    picture: PixelRows,
    first: int,
    palette: NDArray[np.float64],
    out: NDArray[np.uint8],
) -> None:
    """Red, green and blue: the class's colour in the face's light, paler with the distance.

    `camera`: that took the picture. `picture`: taken; its closeness is completed. `palette`:
    (classes, 3). `out`: (rows, W, 3).
    """
    rows, width, _ = out.shape
    _deepen(camera, picture, first, rows)
    for j in range(rows):
        for i in range(width):
            face = picture.face[j, i]
            semantic = picture.semantic[face]
            haze = HAZE / (picture.closeness[j, i] * camera.range_m)
            if face == SKY_FACE:
                haze = 0.0
            shine = picture.light[face] * (1.0 - haze)
            for c in range(3):
                value = palette[semantic, c] * shine + palette[NOTHING, c] * haze
                out[j, i, c] = np.uint8(value)
