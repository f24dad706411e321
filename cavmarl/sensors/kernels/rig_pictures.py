"""What cameras and bird's-eye grids on agents' vehicles see."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import Grid, fill_grid
from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.roads.kernels.backdrop_pieces import Backdrop
from cavmarl.sensors.kernels.birds_eye import BirdsEye, look_down
from cavmarl.sensors.kernels.camera_picture import (
    LEAST_DEPTH_M,
    find_faces,
    look,
    measure_depths,
    write_classes,
    write_colours,
    write_halves,
)
from cavmarl.sensors.kernels.faces import CameraPose, PixelRows
from cavmarl.sensors.kernels.panorama import Panorama, gather
from cavmarl.sensors.kernels.rig_noise import Noise, error_of, sensor_key
from cavmarl.sensors.kernels.rig_schedule import Due


@kernel
def camera_reach_m(camera: CameraPose, width: int, height: int) -> float:
    """How far from the vehicle's place something can be that a pixel shows, m.

    The range is a depth along the axis; corners of the picture see farther.
    """
    across = 0.5 * width / camera.focal
    up = 0.5 * height / camera.focal
    farthest_m = camera.range_m * math.sqrt(1.0 + across * across + up * up)
    return farthest_m + math.hypot(camera.mount[0, 3], camera.mount[1, 3])


@kernel
def _is_noisy(noise: Noise) -> bool:
    """Whether any channel is wrong at all."""
    for channel in range(noise.noise.size):
        if noise.noise[channel] > 0.0 or noise.bias[channel] > 0.0:
            return True
    return False


@kernel
def take_depths(
    worlds: Worlds,
    grid: Grid,
    backdrop: Backdrop,
    due: Due,
    lines: NDArray[np.int32],
    noise: Noise,
    camera: CameraPose,
    panorama: Panorama,
    picture: PixelRows,
    room: NDArray[np.float32],
    room_bits: NDArray[np.uint32],
    data: NDArray[np.uint16],
) -> None:
    """Write the depth pictures that are due of the owned agents.

    `lines`: (W, agents, 2) rows [first, last) of each agent's picture that are written. `noise`: of
    the sensor; what is as far as the range has none. `room`: (rows of `picture`, W) room.
    `room_bits`: the same memory. `data`: (W, agents, S, H, W) float16 as bits, m.
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
            if row["driver"] != DRIVER_AGENT:
                continue
            counts = gather(rows, i, grid, backdrop, reach_m, True, panorama)
            num = find_faces(camera, panorama, counts, picture)
            out = data[w, row["agent"], due.slot[w]]
            begin, end = lines[w, row["agent"], 0], lines[w, row["agent"], 1]
            for first in range(begin, end, band):
                last = min(first + band, end)
                look(camera, picture, num, first, last)
                depths = room[: last - first]
                measure_depths(camera, picture, first, depths)
                if noisy:
                    _add_noise(noise, row, worlds.ticks[w], camera.range_m, first, depths)
                write_halves(room_bits, out[first:last])


@kernel
def _add_noise(
    noise: Noise,
    row: np.void,
    tick: int,
    range_m: float,
    first: int,
    depths: NDArray[np.float32],
) -> None:
    """Make depths (rows, W) less than the range wrong, from a centimetre to the range.

    `first` is their first row in the picture.
    """
    key = sensor_key(row, noise.stream)
    rows, width = depths.shape
    for j in range(rows):
        for i in range(width):
            if depths[j, i] < range_m:
                error = error_of(noise, key, row["id"], tick, (first + j) * width + i, 0)
                depths[j, i] = min(max(depths[j, i] + error, LEAST_DEPTH_M), range_m)


@kernel
def take_classes(
    worlds: Worlds,
    grid: Grid,
    backdrop: Backdrop,
    due: Due,
    lines: NDArray[np.int32],
    camera: CameraPose,
    panorama: Panorama,
    picture: PixelRows,
    data: NDArray[np.uint8],
) -> None:
    """Write the semantic pictures (W, agents, S, H, W) that are due; see `take_depths`."""
    band, width = picture.face.shape
    reach_m = camera_reach_m(camera, width, picture.height)
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        rows = worlds.rows[w]
        fill_grid(rows, worlds.num_rows[w], grid)
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if row["driver"] != DRIVER_AGENT:
                continue
            counts = gather(rows, i, grid, backdrop, reach_m, True, panorama)
            num = find_faces(camera, panorama, counts, picture)
            out = data[w, row["agent"], due.slot[w]]
            begin, end = lines[w, row["agent"], 0], lines[w, row["agent"], 1]
            for first in range(begin, end, band):
                last = min(first + band, end)
                look(camera, picture, num, first, last)
                write_classes(picture, out[first:last])


@kernel
def take_colours(
    worlds: Worlds,
    grid: Grid,
    backdrop: Backdrop,
    due: Due,
    lines: NDArray[np.int32],
    noise: Noise,
    camera: CameraPose,
    panorama: Panorama,
    picture: PixelRows,
    palette: NDArray[np.float64],
    data: NDArray[np.uint8],
) -> None:
    """Write the coloured pictures (W, agents, S, H, W, 3) that are due; see `take_depths`."""
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
            if row["driver"] != DRIVER_AGENT:
                continue
            counts = gather(rows, i, grid, backdrop, reach_m, True, panorama)
            num = find_faces(camera, panorama, counts, picture)
            out = data[w, row["agent"], due.slot[w]]
            begin, end = lines[w, row["agent"], 0], lines[w, row["agent"], 1]
            for first in range(begin, end, band):
                last = min(first + band, end)
                look(camera, picture, num, first, last)
                write_colours(camera, picture, first, palette, out[first:last])
                if noisy:
                    _add_colour_noise(noise, row, worlds.ticks[w], first, out[first:last])


@kernel
def _add_colour_noise(
    noise: Noise, row: np.void, tick: int, first: int, out: NDArray[np.uint8]
) -> None:
    """Make each colour (rows, W, 3) wrong, from 0 to 255; `first` is the first row."""
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
    """Write the bird's-eye grids (W, agents, S, rows, columns) that are due; see `take_depths`.

    `reach_m` is the distance from the vehicle's place to the farthest corner of the grid.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        rows = worlds.rows[w]
        fill_grid(rows, worlds.num_rows[w], grid)
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if row["driver"] != DRIVER_AGENT:
                continue
            counts = gather(rows, i, grid, backdrop, reach_m, True, panorama)
            look_down(view, panorama, counts, data[w, row["agent"], due.slot[w]])
