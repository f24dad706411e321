"""Cameras and bird's-eye grids on agents' vehicles.

In a bird's-eye grid, later objects are drawn over earlier objects, in this order: ground, roads,
lane lines, buildings, bodies by id. The grid is aligned with the sensor's x axis; row 0 is farthest
ahead, column 0 farthest left.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import hypot
from cavmarl.core.math.neighbors import Grid, fill_grid
from cavmarl.core.math.scanlines import row_span
from cavmarl.core.records.arrays import Worlds
from cavmarl.roads.kernels.backdrop_pieces import Backdrop
from cavmarl.sensors.kernels.camera_picture import (
    LEAST_DEPTH_M,
    find_faces,
    look,
    measure_depths,
    write_classes,
    write_colours,
    write_halves,
)
from cavmarl.sensors.kernels.panorama import (
    BUILDING,
    GROUND,
    LANE_LINE,
    ROAD,
    Counts,
    Panorama,
    gather,
)
from cavmarl.sensors.kernels.polygon_fill import CameraPose, PixelRows
from cavmarl.sensors.kernels.rig_frames import Due, Noise, carries, error_of, sensor_key


class BirdsEye(NamedTuple):
    """The pose of a grid in the vehicle's frame, and scratch."""

    x: float  # m, position of the sensor
    y: float
    cos: float  # cosine of its yaw
    sin: float
    ahead_m: float  # distance from the sensor to the upper edge of the grid
    left_m: float  # distance from the sensor to the left edge
    cell_m: float
    edges: NDArray[np.float64]  # (4, 4)
    face: NDArray[np.float64]  # (4, 2) corners in the grid, in cells: column, row


def make_birds_eye(
    mount: NDArray[np.float64], ahead_m: float, left_m: float, cell_m: float
) -> BirdsEye:
    """Create the pose and the scratch memory of a bird's-eye grid.

    Args:
        mount: (3, 4) axes and position in the vehicle's frame, not tilted.
        ahead_m: distance from the sensor to the upper edge.
        left_m: distance from the sensor to the left edge.
        cell_m: side of a cell.
    """
    return BirdsEye(
        float(mount[0, 3]),
        float(mount[1, 3]),
        float(mount[0, 0]),
        float(mount[1, 0]),
        ahead_m,
        left_m,
        cell_m,
        np.zeros((4, 4)),
        np.zeros((4, 2)),
    )


@kernel
def _set_corner(grid: BirdsEye, c: int, x: float, y: float) -> None:
    """Transform a corner from the vehicle's frame to the grid."""
    dx = x - grid.x
    dy = y - grid.y
    grid.face[c, 0] = (grid.left_m - (dy * grid.cos - dx * grid.sin)) / grid.cell_m
    grid.face[c, 1] = (grid.ahead_m - (dx * grid.cos + dy * grid.sin)) / grid.cell_m


@kernel
def _fill(grid: BirdsEye, semantic: int, out: NDArray[np.uint8]) -> None:
    """Fill the cells whose centres lie in the convex quad of the current corners."""
    height, width = out.shape
    face = grid.face
    top = min(min(face[0, 1], face[1, 1]), min(face[2, 1], face[3, 1]))
    bottom = max(max(face[0, 1], face[1, 1]), max(face[2, 1], face[3, 1]))
    left = min(min(face[0, 0], face[1, 0]), min(face[2, 0], face[3, 0]))
    right = max(max(face[0, 0], face[1, 0]), max(face[2, 0], face[3, 0]))
    if not (top < height and bottom > 0.0 and left < width and right > 0.0):
        return
    area = 0.0
    for c in range(4):
        d = c + 1 if c < 3 else 0
        area += face[c, 0] * face[d, 1] - face[d, 0] * face[c, 1]
    sign = math.copysign(1.0, area)
    for c in range(4):
        d = c + 1 if c < 3 else 0
        by_column = -sign * (face[d, 1] - face[c, 1])
        grid.edges[c, 0] = sign * (face[c, 0] * face[d, 1] - face[d, 0] * face[c, 1])
        grid.edges[c, 1] = by_column
        grid.edges[c, 2] = sign * (face[d, 0] - face[c, 0])
        grid.edges[c, 3] = 1.0 / by_column if by_column != 0.0 else 0.0
    for j in range(max(math.floor(top), 0), min(math.ceil(bottom), height)):
        begin, end = row_span(grid.edges, 4, j, width)
        out[j, begin:end] = semantic


@kernel
def _fill_line(
    grid: BirdsEye,
    strip: NDArray[np.float64],
    a: int,
    b: int,
    half_m: float,
    out: NDArray[np.uint8],
) -> None:
    dx = strip[b, 0] - strip[a, 0]
    dy = strip[b, 1] - strip[a, 1]
    length = hypot(dx, dy)
    if length == 0.0:
        return
    x = -dy / length * half_m
    y = dx / length * half_m
    _set_corner(grid, 0, strip[a, 0] - x, strip[a, 1] - y)
    _set_corner(grid, 1, strip[b, 0] - x, strip[b, 1] - y)
    _set_corner(grid, 2, strip[b, 0] + x, strip[b, 1] + y)
    _set_corner(grid, 3, strip[a, 0] + x, strip[a, 1] + y)
    _fill(grid, LANE_LINE, out)


@kernel
def look_down(grid: BirdsEye, panorama: Panorama, counts: Counts, out: NDArray[np.uint8]) -> None:
    """Draw the surroundings of a vehicle into a bird's-eye grid.

    `grid`: pose of the grid. `panorama`: the surroundings, with prisms ordered by id. `out`: (rows,
    columns), overwritten.
    """
    out[:] = GROUND
    for k in range(counts.strips):
        for c in range(4):
            _set_corner(grid, c, panorama.strips[k, c, 0], panorama.strips[k, c, 1])
        _fill(grid, ROAD, out)
    # Lines extend half a cell to each side, so that they show in every row that they cross.
    half_m = 0.5 * grid.cell_m
    for k in range(counts.strips):
        if panorama.lined[k] > 0.0:
            _fill_line(grid, panorama.strips[k], 0, 3, half_m, out)
            _fill_line(grid, panorama.strips[k], 1, 2, half_m, out)
    for k in range(counts.roofs):
        for c in range(4):
            _set_corner(grid, c, panorama.roofs[k, c, 0], panorama.roofs[k, c, 1])
        _fill(grid, BUILDING, out)
    for n in range(counts.prisms):
        prism = panorama.prisms[panorama.order[n]]
        for c in range(4):
            x = prism["half_length"] if c in (0, 3) else -prism["half_length"]
            y = prism["half_width"] if c in (0, 1) else -prism["half_width"]
            cos = prism["cos"]
            sin = prism["sin"]
            _set_corner(grid, c, prism["x"] + x * cos - y * sin, prism["y"] + x * sin + y * cos)
        _fill(grid, prism["semantic"], out)


@kernel
def camera_reach_m(camera: CameraPose, width: int, height: int) -> float:
    """Return the largest distance of a visible point from the vehicle's position, m.

    The range is a depth along the axis; the corners of the picture see farther.
    """
    across = 0.5 * width / camera.focal
    up = 0.5 * height / camera.focal
    farthest_m = camera.range_m * math.sqrt(1.0 + across * across + up * up)
    return farthest_m + hypot(camera.mount[0, 3], camera.mount[1, 3])


@kernel
def _is_noisy(noise: Noise) -> bool:
    for channel in range(noise.noise.size):
        if noise.noise[channel] > 0.0 or noise.bias[channel] > 0.0:
            return True
    return False


@kernel
def take_pictures(
    worlds: Worlds,
    grid: Grid,
    backdrop: Backdrop,
    due: Due,
    lines: NDArray[np.int32],
    noise: Noise,
    camera: CameraPose,
    panorama: Panorama,
    picture: PixelRows,
    scratch: NDArray[np.float32] | None,
    scratch_bits: NDArray[np.uint32] | None,
    palette: NDArray[np.float64] | None,
    classes: bool | None,
    data: NDArray[np.unsignedinteger],
) -> None:
    """Write the due pictures of the owned agents: depths, colours, or classes.

    `lines`: (W, agents, 2) rows [first, last) of each agent's picture to write. `noise`: errors of
    depths below the range, or of colours. `scratch`: (rows of `picture`, W), and `scratch_bits`,
    the same memory; for depths only. `palette`: for colours only. `classes`: True for classes only.
    `data`: (W, agents, S, H, W) float16 as bits, in m; or uint8, (…, 3) for colours.

    Numba does not compile the branches of arguments that are None.
    """
    band, width = picture.face.shape
    reach_m = camera_reach_m(camera, width, picture.height)
    noisy = _is_noisy(noise)
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        rows = worlds.rows[w]
        fill_grid(rows, worlds.num_rows[w], grid)
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if not carries(due, row):
                continue
            counts = gather(rows, i, grid, backdrop, reach_m, True, panorama)
            num = find_faces(camera, panorama, counts, picture)
            shown = data[w, row["agent"], due.slot[w]]
            begin, end = lines[w, row["agent"], 0], lines[w, row["agent"], 1]
            for first in range(begin, end, band):
                last = min(first + band, end)
                look(camera, picture, num, first, last)
                out = shown[first:last]
                if scratch is not None and scratch_bits is not None:
                    depths = scratch[: last - first]
                    measure_depths(camera, picture, first, depths)
                    if noisy:
                        _add_noise(noise, row, worlds.ticks[w], camera.range_m, first, depths)
                    write_halves(scratch_bits, out)
                if palette is not None:
                    write_colours(camera, picture, first, palette, out)
                    if noisy:
                        _add_colour_noise(noise, row, worlds.ticks[w], first, out)
                if classes is not None:
                    write_classes(picture, out)


@kernel
def _add_noise(
    noise: Noise, row: np.void, tick: int, range_m: float, first: int, depths: NDArray[np.float32]
) -> None:
    """Add errors to depths (rows, W) below the range; the results lie between 1 cm and the range.

    `first` is the row of the picture at which `depths` begins.
    """
    key = sensor_key(row, noise.stream)
    rows, width = depths.shape
    for j in range(rows):
        for i in range(width):
            if depths[j, i] < range_m:
                error = error_of(noise, key, row["id"], tick, (first + j) * width + i, 0)
                depths[j, i] = min(max(depths[j, i] + error, LEAST_DEPTH_M), range_m)


@kernel
def _add_colour_noise(
    noise: Noise, row: np.void, tick: int, first: int, out: NDArray[np.uint8]
) -> None:
    """Add errors to colours (rows, W, 3), within 0 and 255; `first`: first row in the picture."""
    key = sensor_key(row, noise.stream)
    rows, width, _ = out.shape
    for j in range(rows):
        for i in range(width):
            for c in range(3):
                draw = ((first + j) * width + i) * 3 + c
                error = error_of(noise, key, row["id"], tick, draw, c)
                out[j, i, c] = np.uint8(min(max(out[j, i, c] + error + 0.5, 0.0), 255.0))


@kernel
def fill_grids(
    worlds: Worlds,
    grid: Grid,
    backdrop: Backdrop,
    due: Due,
    view: BirdsEye,
    reach_m: float,
    panorama: Panorama,
    data: NDArray[np.uint8],
) -> None:
    """Write the due bird's-eye grids (W, agents, S, rows, columns); see `take_pictures`.

    `reach_m`: distance from the vehicle's position to the farthest corner of the grid.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        rows = worlds.rows[w]
        fill_grid(rows, worlds.num_rows[w], grid)
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if not carries(due, row):
                continue
            counts = gather(rows, i, grid, backdrop, reach_m, True, panorama)
            look_down(view, panorama, counts, data[w, row["agent"], due.slot[w]])
