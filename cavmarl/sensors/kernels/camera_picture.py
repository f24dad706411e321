"""What a camera sees: the sky, the ground, roads, and the faces of bodies and walls.

Depth, class and colour of pixels are delivered some rows at a time: of those that have been taken
last, the first being row `first` of the whole picture.
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

# Faces that every picture has; those of bodies and buildings follow.
SKY_FACE = 0
GROUND_FACE = 1
ROAD_FACE = 2
FIRST_FACE = 3

_FACES_OF_PRISM = 6
_SEEN_OF_PRISM = 3  # at most

# With 12 bytes each they stay in a core's second-level cache, beside what is delivered of them.
BAND_PIXELS = 1 << 14


def make_camera(
    mount: NDArray[np.float64], width: int, fov_rad: float, range_m: float
) -> CameraPose:
    """A camera.

    Args:
        mount: (3, 4) axes and place in the vehicle's frame.
        width: pixels.
        fov_rad: horizontal opening, less than pi.
        range_m: deeper places are not seen.
    """
    focal = 0.5 * width / tangent(0.5 * fov_rad)
    return CameraPose(mount, focal, range_m, np.zeros((5, 4)), np.zeros((4, 3)))


def make_picture(width: int, height: int, panorama: Panorama) -> PixelRows:
    """Room for a picture of such a panorama, some rows at a time."""
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
    """Sky, and the ground as far as the camera sees it, in the rows [first, last)."""
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
    """Add the faces of a body that turn to the camera: at most two sides and one end."""
    cos = prism["cos"]
    sin = prism["sin"]
    dx = camera.mount[0, 3] - prism["x"]
    dy = camera.mount[1, 3] - prism["y"]
    ahead = dx * cos + dy * sin
    left = dy * cos - dx * sin
    bottom = prism["bottom"]
    top = prism["top"]
    for side in range(4):
        # Front, left, rear, right: outwards is (along, across).
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
    """How bright an upright face is that looks to (x, y); light comes from ahead on the left."""
    return 0.7 + 0.15 * (x + y)


@kernel
def _add_wall(camera: CameraPose, picture: PixelRows, num: int, wall: np.void, number: int) -> int:
    """Add a wall, which looks the same from both sides."""
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
        # The side that is seen.
        away = x * (camera.mount[0, 3] - ax) + y * (camera.mount[1, 3] - ay)
        picture.light[number] = _light(math.copysign(x, x * away), math.copysign(y, y * away))
    return add_face(camera, picture, num, number, False)


@kernel
def find_faces(camera: CameraPose, panorama: Panorama, counts: Counts, picture: PixelRows) -> int:
    """Find the faces that a picture shows.

    `panorama`: what stands around the vehicle, prisms ordered by id. `picture`: its faces are
    overwritten.

    Returns how many there are.
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
    """Take the rows [first, last) of a picture.

    `picture`: with faces; its rows are overwritten from the first on. `num`: how many faces there
    are. `last`: the one after the last; as many as there is room for, at most.
    """
    _clear(camera, picture, first, last)
    draw_faces(picture, num, first, last)


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
