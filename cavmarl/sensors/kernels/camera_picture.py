"""Camera pictures: sky, ground, roads, and the faces of bodies and walls.

A picture is rendered in bands of rows. The functions that write depths, classes or colours read the
last rendered band; `first` is the row of the whole picture at which the band begins.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import hypot, tangent
from cavmarl.core.math.scanlines import row_span
from cavmarl.sensors.kernels.panorama import (
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
    Counts,
    Panorama,
)
from cavmarl.sensors.kernels.polygon_fill import (
    CameraPose,
    Faces,
    PixelRows,
    add_face,
    draw_faces,
    ground_at,
    set_corner,
)

# These faces are in every picture; the faces of bodies and buildings follow.
SKY_FACE = 0
GROUND_FACE = 1
ROAD_FACE = 2
FIRST_FACE = 3

_FACES_OF_PRISM = 6
_SEEN_OF_PRISM = 3  # largest number of faces that one camera sees

# With 12 bytes per pixel, a band and its output fit in the second-level cache of a core.
BAND_PIXELS = 1 << 14


def make_camera(
    mount: NDArray[np.float64], width: int, fov_rad: float, range_m: float
) -> CameraPose:
    """Create a camera.

    Args:
        mount: (3, 4) axes and position in the vehicle's frame.
        width: width of the picture in pixels.
        fov_rad: horizontal field of view, less than pi.
        range_m: largest visible depth.
    """
    focal = 0.5 * width / tangent(0.5 * fov_rad)
    return CameraPose(mount, focal, range_m, np.zeros((5, 4)), np.zeros((4, 3)))


def make_picture(width: int, height: int, panorama: Panorama) -> PixelRows:
    """Allocate the rows of a picture, for scenes of the size of `panorama`."""
    faces = FIRST_FACE + _FACES_OF_PRISM * len(panorama.prisms) + len(panorama.walls)
    semantic = np.zeros(faces, np.uint8)
    semantic[:FIRST_FACE] = NOTHING, GROUND, ROAD
    seen = len(panorama.strips) + _SEEN_OF_PRISM * len(panorama.prisms) + len(panorama.walls)
    rows = min(height, max(1, BAND_PIXELS // width))
    return PixelRows(
        height,
        np.zeros((rows, width)),
        np.zeros((rows, width), np.int32),
        semantic,
        np.ones(faces),
        Faces(
            np.zeros((seen, 5, 4)),
            np.zeros((seen, 3)),
            np.zeros((seen, 2), np.int32),
            np.zeros(seen, np.int32),
            np.zeros(seen, np.bool_),
        ),
    )


@kernel
def _clear(camera: CameraPose, picture: PixelRows, first: int, last: int) -> None:
    """Fill the rows [first, last) with sky and, within the camera's range, with ground."""
    width = picture.face.shape[1]
    mount = camera.mount
    picture.closeness[: last - first] = 0.0
    picture.face[: last - first] = SKY_FACE
    if mount[2, 3] <= 0.0:
        return
    ground_at(camera, width, picture.height)
    camera.edges[4, 0] -= 1.0 / camera.range_m
    for j in range(first, last):
        begin, end = row_span(camera.edges[4:], 1, j, width)
        picture.face[j - first, begin:end] = GROUND_FACE


@kernel
def _corner_of(prism: np.void, along: float, across: float) -> tuple[float, float]:
    x = along * prism["half_length"]
    y = across * prism["half_width"]
    cos = prism["cos"]
    sin = prism["sin"]
    return prism["x"] + x * cos - y * sin, prism["y"] + x * sin + y * cos


@kernel
def _add_prism(camera: CameraPose, picture: PixelRows, num: int, prism: np.void, first: int) -> int:
    """Add the sides of a body that the camera sees: at most two, and the top or the bottom."""
    cos = prism["cos"]
    sin = prism["sin"]
    dx = camera.mount[0, 3] - prism["x"]
    dy = camera.mount[1, 3] - prism["y"]
    ahead = dx * cos + dy * sin
    left = dy * cos - dx * sin
    bottom = prism["bottom"]
    top = prism["top"]
    for side in range(4):
        # The sides are front, left, rear, right; (along, across) is the outward normal.
        along = 1.0 if side == 0 else (-1.0 if side == 2 else 0.0)
        across = 1.0 if side == 1 else (-1.0 if side == 3 else 0.0)
        out = ahead * along + left * across
        if out <= (prism["half_length"] if across == 0.0 else prism["half_width"]):
            continue
        x1, y1 = _corner_of(prism, along + across, across - along)
        x2, y2 = _corner_of(prism, along - across, across + along)
        set_corner(camera, 0, x1, y1, bottom)
        set_corner(camera, 1, x2, y2, bottom)
        set_corner(camera, 2, x2, y2, top)
        set_corner(camera, 3, x1, y1, top)
        picture.semantic[first + side] = prism["semantic"]
        picture.light[first + side] = _light(along * cos - across * sin, along * sin + across * cos)
        num = add_face(camera, picture, num, first + side, False)
    z = camera.mount[2, 3]
    if z > top or z < bottom:
        level = top if z > top else bottom
        for corner in range(4):
            along = 1.0 if corner in (0, 3) else -1.0
            across = 1.0 if corner in (0, 1) else -1.0
            x, y = _corner_of(prism, along, across)
            set_corner(camera, corner, x, y, level)
        number = first + (4 if z > top else 5)
        picture.semantic[number] = prism["semantic"]
        picture.light[number] = 1.0 if z > top else 0.3
        num = add_face(camera, picture, num, number, False)
    return num


@kernel
def _light(x: float, y: float) -> float:
    """Return the brightness of an upright face with normal (x, y), lit from ahead left."""
    return 0.7 + 0.15 * (x + y)


@kernel
def _add_wall(camera: CameraPose, picture: PixelRows, num: int, wall: np.void, number: int) -> int:
    """Add a wall; both of its sides look the same."""
    ax, ay, bx, by = wall["ax"], wall["ay"], wall["bx"], wall["by"]
    height = wall["height"]
    set_corner(camera, 0, ax, ay, 0.0)
    set_corner(camera, 1, bx, by, 0.0)
    set_corner(camera, 2, bx, by, height)
    set_corner(camera, 3, ax, ay, height)
    picture.semantic[number] = BUILDING
    length = hypot(bx - ax, by - ay)
    if length > 0.0:
        x, y = (by - ay) / length, (ax - bx) / length
        # Shade the side that faces the camera.
        away = x * (camera.mount[0, 3] - ax) + y * (camera.mount[1, 3] - ay)
        picture.light[number] = _light(math.copysign(x, x * away), math.copysign(y, y * away))
    return add_face(camera, picture, num, number, False)


@kernel
def find_faces(camera: CameraPose, panorama: Panorama, counts: Counts, picture: PixelRows) -> int:
    """Find the faces that a picture shows, and return their number.

    `panorama`: the scene around the vehicle, with prisms ordered by id. `picture`: the faces are
    overwritten.
    """
    num = 0
    if camera.mount[2, 3] > 0.0:
        for k in range(counts.strips):
            for c in range(4):
                set_corner(camera, c, panorama.strips[k, c, 0], panorama.strips[k, c, 1], 0.0)
            num = add_face(camera, picture, num, ROAD_FACE, True)
    for n in range(counts.prisms):
        k = panorama.order[n]
        first = FIRST_FACE + _FACES_OF_PRISM * k
        num = _add_prism(camera, picture, num, panorama.prisms[k], first)
    first = FIRST_FACE + _FACES_OF_PRISM * panorama.prisms.size
    for k in range(counts.walls):
        num = _add_wall(camera, picture, num, panorama.walls[k], first + k)
    return num


@kernel
def look(camera: CameraPose, picture: PixelRows, num: int, first: int, last: int) -> None:
    """Render the rows [first, last) of a picture.

    `picture`: contains the faces; its rows are overwritten, and its row 0 becomes row `first`.
    `num`: number of faces. `last`: at most `first` plus the number of rows of `picture`.
    """
    _clear(camera, picture, first, last)
    draw_faces(picture, num, first, last)


# Lower bound of depths, for cameras inside a body.
LEAST_DEPTH_M = 0.01

# Conversion from float32 to float16: the number of dropped bits, and the difference of the exponent
# biases minus half of the dropped range.
_DROPPED = np.uint32(13)
_ONE = np.uint32(1)
_REBIAS = np.uint32((112 << 23) - 0xFFF)

# Share of a colour that haze removes at the end of the range.
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
    """Return the colour of each class in full light, (classes, 3) red, green, blue."""
    found = np.zeros((NUM_SEMANTICS, 3))
    for semantic, colour in _COLOURS.items():
        found[semantic] = colour
    return found


@kernel
def _complete_closeness(camera: CameraPose, picture: PixelRows, first: int, rows: int) -> None:
    """Set the closeness of the remaining pixels, which show ground or sky."""
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
    """Write depths (rows, W) in m along the optical axis; pixels that show nothing get the range.

    `camera`: the camera of the picture. `picture`: rendered rows; their closeness is completed.
    `out`: (rows, W).
    """
    rows, width = out.shape
    _complete_closeness(camera, picture, first, rows)
    nearest = np.float32(LEAST_DEPTH_M)
    for j in range(rows):
        for i in range(width):
            out[j, i] = max(np.float32(1.0 / picture.closeness[j, i]), nearest)


@kernel
def write_halves(bits: NDArray[np.uint32], out: NDArray[np.uint16]) -> None:
    """Convert the bits of float32 numbers (rows, W) between 2^-14 and 65504 to bits of float16.

    Numbers are rounded to the nearest float16, ties to even.
    """
    rows, width = out.shape
    for j in range(rows):
        for i in range(width):
            half = bits[j, i] - _REBIAS + ((bits[j, i] >> _DROPPED) & _ONE)
            out[j, i] = np.uint16(half >> _DROPPED)


@kernel
def write_classes(picture: PixelRows, out: NDArray[np.uint8]) -> None:
    """Write the class (rows, W) of each pixel."""
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
    """Write colours: the colour of the class, shaded by the face, and paler with distance.

    `camera`: the camera of the picture. `picture`: rendered rows; their closeness is completed.
    `palette`: (classes, 3). `out`: (rows, W, 3) red, green, blue.
    """
    rows, width, _ = out.shape
    _complete_closeness(camera, picture, first, rows)
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
