"""Rasterization of flat convex faces in the picture of a pinhole camera.

The reciprocal of a face's depth is linear in picture coordinates, and so are the half-planes of the
face's edges. A face is drawn row by row, from its first to its last column, with one addition per
pixel; the nearest face is kept. The method is exact for every orientation of the camera, including
roll, and casts no rays.

A picture is drawn in bands of rows. A band with all its data per pixel fits in the core's own
cache. Rows do not depend on each other, and only results are written to memory that cores share.

Depth is measured along the optical axis. The camera's axes are the axes of its mount: ahead, left,
up. Pixel rows go down, columns go right, and pixels are square.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.scanlines import row_span

# If a corner of a face is nearer than this, or behind the camera, all rows are tested.
NEAR_M = 0.01


class CameraPose(NamedTuple):
    """The pose and the optics of a camera."""

    mount: NDArray[np.float64]  # (3, 4) axes (ahead, left, up), position in the vehicle's frame
    focal: float  # focal length in pixels
    range_m: float  # largest depth
    edges: NDArray[np.float64]  # (5, 4) scratch: edges of one face
    face: NDArray[np.float64]  # (4, 3) scratch: corners of one face in the camera's frame


class Faces(NamedTuple):
    """The visible faces of one picture, in drawing order."""

    edges: NDArray[np.float64]  # (F, 5, 4) edges of each face; the fifth limits the range
    plane: NDArray[np.float64]  # (F, 3) closeness: constant, change per column, change per row
    rows: NDArray[np.int32]  # (F, 2) rows [first, last) that the face can cover
    number: NDArray[np.int32]  # (F,) index of the face
    flat: NDArray[np.bool_]  # (F,) whether the face lies on the ground and covers earlier faces


class PixelRows(NamedTuple):
    """R rendered rows of a picture, which is rendered from top to bottom, and its faces."""

    height: int  # height of the whole picture, pixels
    closeness: NDArray[np.float64]  # (R, W) 1 / depth in 1/m; 0: no body and no building
    face: NDArray[np.int32]  # (R, W) index of the visible face
    semantic: NDArray[np.uint8]  # (all faces,) class of each face
    light: NDArray[np.float64]  # (all faces,) brightness of each face, in [0, 1]
    faces: Faces


@kernel
def set_corner(camera: CameraPose, c: int, x: float, y: float, z: float) -> None:
    """Transform a corner of the face from the vehicle's frame to the camera's."""
    mount = camera.mount
    dx = x - mount[0, 3]
    dy = y - mount[1, 3]
    dz = z - mount[2, 3]
    for axis in range(3):
        camera.face[c, axis] = dx * mount[0, axis] + dy * mount[1, axis] + dz * mount[2, axis]


@kernel
def _set_edge(
    camera: CameraPose, k: int, x: float, y: float, z: float, width: int, height: int
) -> None:
    """Set edge k: the pixels whose direction (1, -u', -v') times (x, y, z) is not negative."""
    by_column = -y / camera.focal
    by_row = -z / camera.focal
    edges = camera.edges
    edges[k, 0] = x - 0.5 * width * by_column - 0.5 * height * by_row
    edges[k, 1] = by_column
    edges[k, 2] = by_row
    edges[k, 3] = 1.0 / by_column if by_column != 0.0 else 0.0


@kernel
def _is_aside(camera: CameraPose, width: int, height: int) -> bool:
    """Return whether all corners are behind the camera, or all beyond one edge of the picture."""
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
def _set_face(camera: CameraPose, width: int, height: int) -> tuple[int, int, float, float, float]:
    """Set the edges of the face with the current corners; the fifth edge limits the range.

    Returns the rows [first, last) that the face can cover, and the closeness of its plane:
    constant, change per column, change per row. A face that cannot be seen has no rows.
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
    # This is one row more than needed; the edges exclude it.
    first = max(math.floor(max(low * camera.focal + 0.5 * height, 0.0) - 1.0), 0)
    last = min(math.ceil(min(high * camera.focal + 0.5 * height, float(height)) + 1.0), height)
    return first, last, constant, by_column, by_row


@kernel
def add_face(camera: CameraPose, picture: PixelRows, num: int, number: int, flat: bool) -> int:
    """Append the face with the current corners to the `num` faces drawn before it.

    Returns the new number of faces, which is `num` if the face cannot be seen.
    """
    width = picture.face.shape[1]
    first, last, constant, by_column, by_row = _set_face(camera, width, picture.height)
    if first >= last:
        return num
    faces = picture.faces
    for k in range(5):
        for n in range(4):
            faces.edges[num, k, n] = camera.edges[k, n]
    faces.plane[num, 0] = constant
    faces.plane[num, 1] = by_column
    faces.plane[num, 2] = by_row
    faces.rows[num, 0] = first
    faces.rows[num, 1] = last
    faces.number[num] = number
    faces.flat[num] = flat
    return num + 1


@kernel
def draw_faces(picture: PixelRows, num: int, first: int, last: int) -> None:
    """Draw the first `num` faces in the rows [first, last), hiding what is farther away."""
    faces = picture.faces
    for k in range(num):
        begin_row = max(first, faces.rows[k, 0])
        end_row = min(last, faces.rows[k, 1])
        if begin_row < end_row and faces.flat[k]:
            _draw_flat(picture, k, first, begin_row, end_row)
        elif begin_row < end_row:
            _draw(picture, k, first, begin_row, end_row)


@kernel
def _draw(picture: PixelRows, k: int, first: int, begin_row: int, end_row: int) -> None:
    """Draw a face, hiding what is farther away; `first` is the first row in memory."""
    width = picture.face.shape[1]
    edges = picture.faces.edges[k]
    plane = picture.faces.plane[k]
    constant, by_column, by_row = plane[0], plane[1], plane[2]
    number = picture.faces.number[k]
    for j in range(begin_row, end_row):
        begin, end = row_span(edges, 5, j, width)
        start = constant + by_row * (j + 0.5) + by_column * 0.5
        closeness = picture.closeness[j - first]
        face = picture.face[j - first]
        for i in range(begin, end):
            value = start + by_column * i
            nearer = value > closeness[i]
            closeness[i] = value if nearer else closeness[i]
            face[i] = number if nearer else face[i]


@kernel
def _draw_flat(picture: PixelRows, k: int, first: int, begin_row: int, end_row: int) -> None:
    """Draw a face over everything drawn before it."""
    width = picture.face.shape[1]
    edges = picture.faces.edges[k]
    number = picture.faces.number[k]
    for j in range(begin_row, end_row):
        begin, end = row_span(edges, 5, j, width)
        picture.face[j - first, begin:end] = number


@kernel
def ground_at(camera: CameraPose, width: int, height: int) -> tuple[float, float, float]:
    """Return the ground's closeness (constant, change per column, per row); overwrite edge 4.

    A camera at ground level does not see the ground.
    """
    mount = camera.mount
    z = -mount[2, 3]
    if z >= 0.0:
        return 0.0, 0.0, 0.0
    _set_edge(camera, 4, mount[2, 0] / z, mount[2, 1] / z, mount[2, 2] / z, width, height)
    return camera.edges[4, 0], camera.edges[4, 1], camera.edges[4, 2]
