"""A pinhole camera: what each pixel shows of bodies, walls, roads and the ground.

Everything that it can see is a flat convex face. Seen by a pinhole, one over the depth of a face is
linear over the picture, and so are the sides of its edges: a face is drawn row by row, from the
first to the last column of the row inside it, with one addition a pixel, and the nearest face
stays. That is exact for every direction of the camera, roll included, and no ray is cast.

Depth is along the optical axis. The camera's axes are those of its mount: ahead, left, up; pixel
rows go down, columns to the right, and pixels are square.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.panorama import Counts, Panorama
from cavmarl.kernels.semantics import BUILDING, GROUND, NOTHING, ROAD
from cavmarl.kernels.spans import row_span

__all__ = [
    "GROUND_FACE",
    "ROAD_FACE",
    "SKY_FACE",
    "Camera",
    "Picture",
    "ground_at",
    "look",
    "make_camera",
    "make_picture",
]

# Faces that every picture has; those of bodies and buildings follow.
SKY_FACE = 0
GROUND_FACE = 1
ROAD_FACE = 2
FIRST_FACE = 3

_FACES_OF_PRISM = 6

# Of a face with a corner nearer than this, or behind the camera, all rows are tried.
NEAR_M = 0.01


class Camera(NamedTuple):
    """Where a camera looks from and how."""

    mount: NDArray[np.float64]  # (3, 4) axes (ahead, left, up) and place in the vehicle's frame
    focal: float  # pixels
    range_m: float  # of depths
    edges: NDArray[np.float64]  # (5, 4) room for those of one face
    face: NDArray[np.float64]  # (4, 3) room for its corners in the camera's frame


class Picture(NamedTuple):
    """What the pixels show; rows from top to bottom."""

    closeness: NDArray[np.float64]  # (H, W) one over the depth in m; 0: no body and no building
    face: NDArray[np.int32]  # (H, W) a face
    semantic: NDArray[np.uint8]  # (F,) of each face
    light: NDArray[np.float64]  # (F,) how bright each face is, in [0, 1]


def make_camera(mount: NDArray[np.float64], width: int, fov_rad: float, range_m: float) -> Camera:
    """A camera.

    Args:
        mount: (3, 4) axes and place in the vehicle's frame.
        width: pixels.
        fov_rad: horizontal opening, less than pi.
        range_m: deeper places are not seen.
    """
    focal = 0.5 * width / math.tan(0.5 * fov_rad)
    return Camera(mount, focal, range_m, np.zeros((5, 4)), np.zeros((4, 3)))


def make_picture(width: int, height: int, panorama: Panorama) -> Picture:
    """Room for a picture of such a panorama."""
    faces = FIRST_FACE + _FACES_OF_PRISM * len(panorama.prisms) + len(panorama.walls)
    semantic = np.zeros(faces, np.uint8)
    semantic[:FIRST_FACE] = NOTHING, GROUND, ROAD
    light = np.ones(faces)
    return Picture(np.zeros((height, width)), np.zeros((height, width), np.int32), semantic, light)


@kernel
def _set_corner(camera: Camera, c: int, x: float, y: float, z: float) -> None:
    """Bring a corner of the face from the vehicle's frame into the camera's."""
    mount = camera.mount
    dx = x - mount[0, 3]
    dy = y - mount[1, 3]
    dz = z - mount[2, 3]
    for axis in range(3):
        camera.face[c, axis] = dx * mount[0, axis] + dy * mount[1, axis] + dz * mount[2, axis]


@kernel
def _set_edge(
    camera: Camera, k: int, x: float, y: float, z: float, width: int, height: int
) -> None:
    """Edge k: the pixels whose direction (1, -u', -v') has no negative product with (x, y, z)."""
    by_column = -y / camera.focal
    by_row = -z / camera.focal
    edges = camera.edges
    edges[k, 0] = x - 0.5 * width * by_column - 0.5 * height * by_row
    edges[k, 1] = by_column
    edges[k, 2] = by_row
    edges[k, 3] = 1.0 / by_column if by_column != 0.0 else 0.0


@kernel
def _is_aside(camera: Camera, width: int, height: int) -> bool:
    """Whether all corners of the face are behind the camera, or beside one edge of the picture."""
    face = camera.face
    slope_x = 0.5 * width / camera.focal
    slope_z = 0.5 * height / camera.focal
    behind = left = right = over = under = True
    for c in range(4):
        behind &= face[c, 0] <= 0.0
        left &= face[c, 1] > slope_x * face[c, 0]
        right &= -face[c, 1] > slope_x * face[c, 0]
        over &= face[c, 2] > slope_z * face[c, 0]
        under &= -face[c, 2] > slope_z * face[c, 0]
    return behind | left | right | over | under


@kernel
def _set_face(camera: Camera, width: int, height: int) -> tuple[int, int, float, float, float]:
    """Set the edges of the face whose corners are set, the fifth being the range.

    Returns:
        the rows [first, last) that it can be in, and the closeness of the plane that it lies in:
        constant, by column, by row. No rows for a face that cannot be seen.
    """
    if _is_aside(camera, width, height):
        return 0, 0, 0.0, 0.0, 0.0
    face = camera.face
    ax, ay, az = face[1, 0] - face[0, 0], face[1, 1] - face[0, 1], face[1, 2] - face[0, 2]
    bx, by, bz = face[3, 0] - face[0, 0], face[3, 1] - face[0, 1], face[3, 2] - face[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    volume = nx * face[0, 0] + ny * face[0, 1] + nz * face[0, 2]
    if volume == 0.0:
        return 0, 0, 0.0, 0.0, 0.0
    sign = math.copysign(1.0, volume)
    low = np.inf
    high = -np.inf
    in_front = True
    for c in range(4):
        d = c + 1 if c < 3 else 0
        px, py, pz = face[c, 0], face[c, 1], face[c, 2]
        qx, qy, qz = face[d, 0], face[d, 1], face[d, 2]
        _set_edge(
            camera,
            c,
            sign * (py * qz - pz * qy),
            sign * (pz * qx - px * qz),
            sign * (px * qy - py * qx),
            width,
            height,
        )
        if px > NEAR_M:
            low = min(low, -pz / px)
            high = max(high, -pz / px)
        else:
            in_front = False
    _set_edge(camera, 4, nx / volume, ny / volume, nz / volume, width, height)
    edges = camera.edges
    constant, by_column, by_row = edges[4, 0], edges[4, 1], edges[4, 2]
    edges[4, 0] -= 1.0 / camera.range_m
    if not in_front:
        return 0, height, constant, by_column, by_row
    # One row more than needed: the edges tell.
    first = max(math.floor(max(low * camera.focal + 0.5 * height, 0.0) - 1.0), 0)
    last = min(math.ceil(min(high * camera.focal + 0.5 * height, float(height)) + 1.0), height)
    return first, last, constant, by_column, by_row


@kernel
def _draw(camera: Camera, picture: Picture, number: int) -> None:
    """Draw the face whose corners are set over what is farther away."""
    height, width = picture.face.shape
    first, last, constant, by_column, by_row = _set_face(camera, width, height)
    for j in range(first, last):
        begin, end = row_span(camera.edges, 5, j, width)
        start = constant + by_row * (j + 0.5) + by_column * 0.5
        closeness = picture.closeness[j]
        face = picture.face[j]
        for i in range(begin, end):
            value = start + by_column * i
            nearer = value > closeness[i]
            closeness[i] = value if nearer else closeness[i]
            face[i] = number if nearer else face[i]


@kernel
def _draw_on_ground(camera: Camera, picture: Picture, number: int) -> None:
    """Draw the face whose corners are set over whatever was there."""
    height, width = picture.face.shape
    first, last, _, _, _ = _set_face(camera, width, height)
    for j in range(first, last):
        begin, end = row_span(camera.edges, 5, j, width)
        picture.face[j, begin:end] = number


@kernel
def _clear(camera: Camera, picture: Picture) -> None:
    """Sky, and the ground as far as the camera sees it."""
    height, width = picture.face.shape
    mount = camera.mount
    picture.closeness[:] = 0.0
    picture.face[:] = SKY_FACE
    if mount[2, 3] <= 0.0:
        return
    ground_at(camera, width, height)
    camera.edges[4, 0] -= 1.0 / camera.range_m
    for j in range(height):
        begin, end = row_span(camera.edges[4:], 1, j, width)
        picture.face[j, begin:end] = GROUND_FACE


@kernel
def ground_at(camera: Camera, width: int, height: int) -> tuple[float, float, float]:
    """The closeness of the ground: constant, by column, by row. Overwrites edge 4.

    A camera on the ground does not see it.
    """
    mount = camera.mount
    z = -mount[2, 3]
    if z >= 0.0:
        return 0.0, 0.0, 0.0
    _set_edge(camera, 4, mount[2, 0] / z, mount[2, 1] / z, mount[2, 2] / z, width, height)
    return camera.edges[4, 0], camera.edges[4, 1], camera.edges[4, 2]


@kernel
def _corner_of(prism: np.void, along: float, across: float) -> tuple[float, float]:
    """A corner of a body's outline."""
    x = along * prism["half_length"]
    y = across * prism["half_width"]
    cos = prism["cos"]
    sin = prism["sin"]
    return prism["x"] + x * cos - y * sin, prism["y"] + x * sin + y * cos


@kernel
def _draw_prism(camera: Camera, picture: Picture, prism: np.void, first: int) -> None:
    """Draw the faces of a body that turn to the camera: at most two sides and one end."""
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
        _set_corner(camera, 0, x1, y1, bottom)
        _set_corner(camera, 1, x2, y2, bottom)
        _set_corner(camera, 2, x2, y2, top)
        _set_corner(camera, 3, x1, y1, top)
        picture.semantic[first + side] = prism["semantic"]
        picture.light[first + side] = _light(along * cos - across * sin, along * sin + across * cos)
        _draw(camera, picture, first + side)
    z = camera.mount[2, 3]
    if z > top or z < bottom:
        level = top if z > top else bottom
        for corner in range(4):
            along = 1.0 if corner in (0, 3) else -1.0
            across = 1.0 if corner in (0, 1) else -1.0
            x, y = _corner_of(prism, along, across)
            _set_corner(camera, corner, x, y, level)
        number = first + (4 if z > top else 5)
        picture.semantic[number] = prism["semantic"]
        picture.light[number] = 1.0 if z > top else 0.3
        _draw(camera, picture, number)


@kernel
def _light(x: float, y: float) -> float:
    """How bright an upright face is that looks to (x, y); light comes from ahead on the left."""
    return 0.7 + 0.15 * (x + y)


@kernel
def _draw_wall(camera: Camera, picture: Picture, wall: np.void, number: int) -> None:
    """Draw a wall, which looks the same from both sides."""
    ax, ay, bx, by = wall["ax"], wall["ay"], wall["bx"], wall["by"]
    height = wall["height"]
    _set_corner(camera, 0, ax, ay, 0.0)
    _set_corner(camera, 1, bx, by, 0.0)
    _set_corner(camera, 2, bx, by, height)
    _set_corner(camera, 3, ax, ay, height)
    picture.semantic[number] = BUILDING
    length = math.hypot(bx - ax, by - ay)
    if length > 0.0:
        x, y = (by - ay) / length, (ax - bx) / length
        # The side that is seen.
        away = x * (camera.mount[0, 3] - ax) + y * (camera.mount[1, 3] - ay)
        picture.light[number] = _light(math.copysign(x, x * away), math.copysign(y, y * away))
    _draw(camera, picture, number)


@kernel
def look(
    camera: Camera,
    panorama: Panorama,
    counts: Counts,
    picture: Picture,
) -> None:
    """Take a picture.

    Args:
        camera: where it looks from.
        panorama: what stands around the vehicle, prisms ordered by id.
        counts: how many things of each kind there are.
        picture: overwritten.
    """
    _clear(camera, picture)
    if camera.mount[2, 3] > 0.0:
        for k in range(counts.strips):
            for c in range(4):
                _set_corner(camera, c, panorama.strips[k, c, 0], panorama.strips[k, c, 1], 0.0)
            _draw_on_ground(camera, picture, ROAD_FACE)
    for n in range(counts.prisms):
        k = panorama.order[n]
        _draw_prism(camera, picture, panorama.prisms[k], FIRST_FACE + _FACES_OF_PRISM * k)
    first = FIRST_FACE + _FACES_OF_PRISM * panorama.prisms.size
    for k in range(counts.walls):
        _draw_wall(camera, picture, panorama.walls[k], first + k)
