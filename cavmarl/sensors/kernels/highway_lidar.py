"""highway-env's `LidarObservation`: distance and radial speed in equal sectors around a vehicle.

The sectors do not turn with the vehicle: the centre of cell k lies k steps clockwise from east (the
frame of `vehicle_features`). The sensor copies highway-env, so it differs from `lidar`, whose rays
intersect bodies exactly and turn with the vehicle. A vehicle is seen if its centre is in range. It
is also drawn into the cell of its centre, at the distance of the centre minus half the vehicle's
width. Inside a body, distances are negative. In empty cells, distance and speed are equal to the
range. With `normalize`, distances and speeds are then divided by the range in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cosine, sine
from cavmarl.core.math.elementary_arrays import cos_all, sin_all
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows

TWO_PI = 2.0 * math.pi


def cell_directions(cells: int) -> NDArray[np.float64]:
    """Return cosine and sine (cells, 2) of each cell's centre, clockwise from east."""
    angles = np.arange(cells) * (2.0 * np.pi / max(cells, 1))
    return np.stack([cos_all(angles), sin_all(angles)], axis=1)


class LidarCells(NamedTuple):
    """Settings and scratch of highway-env's `LidarObservation`."""

    at: int
    cells: int  # 0: off
    range_m: float
    scale: float  # divisor of distances and speeds
    directions: NDArray[np.float64]  # (cells, 2) cosine and sine of each cell's centre
    echoes: NDArray[np.void]  # ECHO (cells,) scratch


@kernel
def _cell_of(x: float, y: float, cells: int) -> tuple[int, float]:
    """Return the cell of a direction, and the angle from which highway-env computes it."""
    step = TWO_PI / cells
    angle = atan2(y, x) + 0.5 * step
    return math.floor(angle / step) % cells, angle


@kernel
def _axis_interval(start: float, size: float, slope: float) -> tuple[float, float]:
    """Return where a ray enters and leaves the strip between two parallel lines, in ray lengths."""
    if slope == 0.0:
        return (-math.inf, math.inf) if start < 0.0 < start + size else (math.inf, math.inf)
    near = start / slope
    far = (start + size) / slope
    return (near, far) if slope > 0.0 else (far, near)


@kernel
def _overlap(low_1: float, high_1: float, low_2: float, high_2: float) -> bool:
    """Return whether two intervals share a point."""
    gap = low_2 - high_1 if low_1 < low_2 else low_1 - high_2
    return gap <= 0.0


@kernel
def _ray_to_body(
    x: float, y: float, cos: float, sin: float, body: np.void, ray_x: float, ray_y: float
) -> float:
    """Return the distance along a ray to a body in ray lengths; negative inside, inf if missed.

    `x`, `y`: the body's centre. `cos`, `sin`: the body's heading. `body`: its size. `ray_x`,
    `ray_y`: the ray, whose length is the range.
    """
    length = 2.0 * body["half_length"]
    width = 2.0 * body["half_width"]
    # Rear corner with the smaller lateral offset, along both axes of the body.
    along = x * cos + y * sin - body["half_length"]
    across = y * cos - x * sin - body["half_width"]
    enter_1, leave_1 = _axis_interval(across, width, ray_y * cos - ray_x * sin)
    enter_2, leave_2 = _axis_interval(along, length, ray_x * cos + ray_y * sin)
    if (
        _overlap(enter_1, leave_1, enter_2, leave_2)
        and _overlap(0.0, 1.0, enter_1, leave_1)
        and _overlap(0.0, 1.0, enter_2, leave_2)
    ):
        return max(enter_1, enter_2)
    return math.inf


@kernel
def _cells_over(
    x: float, y: float, cos: float, sin: float, body: np.void, cells: int
) -> tuple[int, int]:
    """Return the first and the last cell that highway-env tests for a body, clockwise."""
    smallest, largest = math.inf, -math.inf
    for side in range(4):
        along = body["half_length"] if side >= 2 else -body["half_length"]
        across = body["half_width"] if side % 2 == 1 else -body["half_width"]
        _, angle = _cell_of(x + along * cos - across * sin, y + along * sin + across * cos, cells)
        smallest = min(smallest, angle)
        largest = max(largest, angle)
    if smallest < -0.5 * math.pi and largest > 0.5 * math.pi:
        smallest, largest = largest, smallest + TWO_PI
    step = TWO_PI / cells
    return math.floor(smallest / step) % cells, math.floor(largest / step) % cells


@kernel
def _record(echo: np.void, distance: float, speed: float, vehicle_id: int) -> None:
    """Keep the nearest echo; on a tie, keep the larger id, which highway-env draws last."""
    if distance < echo["distance"] or (distance == echo["distance"] and vehicle_id >= echo["id"]):
        echo["distance"] = distance
        echo["speed"] = speed
        echo["id"] = vehicle_id


@kernel
def _trace(ego: np.void, ego_cos: float, ego_sin: float, body: np.void, sensor: LidarCells) -> None:
    x = body["x"] - ego["x"]
    y = ego["y"] - body["y"]
    distance = math.sqrt(x * x + y * y)
    if distance > sensor.range_m:
        return
    cos, sin = body["cos"], -body["sin"]
    velocity_x = body["speed"] * cos - ego["speed"] * ego_cos
    velocity_y = body["speed"] * sin - ego["speed"] * ego_sin
    cell, _ = _cell_of(x, y, sensor.cells)
    speed = velocity_x * sensor.directions[cell, 0] + velocity_y * sensor.directions[cell, 1]
    _record(sensor.echoes[cell], distance - body["half_width"], speed, body["id"])
    cell, last = _cells_over(x, y, cos, sin, body, sensor.cells)
    count = last - cell + 1 if cell < last else sensor.cells - cell + last + 1
    for _ in range(count):
        ray_x, ray_y = sensor.directions[cell, 0], sensor.directions[cell, 1]
        share = _ray_to_body(x, y, cos, sin, body, sensor.range_m * ray_x, sensor.range_m * ray_y)
        speed = velocity_x * ray_x + velocity_y * ray_y
        _record(sensor.echoes[cell], share * sensor.range_m, speed, body["id"])
        cell = cell + 1 if cell + 1 < sensor.cells else 0


@kernel
def observe_lidar_cells(
    rows: NDArray[np.void], i: int, grid: Grid, sensor: LidarCells, out: NDArray[np.float32]
) -> None:
    """Write the distance and speed of each cell.

    `out`: an observation; 2 · cells numbers are written, starting at `sensor.at`.
    """
    ego = rows[i]
    ego_cos = cosine(ego["heading"])
    ego_sin = -sine(ego["heading"])
    for k in range(sensor.cells):
        echo = sensor.echoes[k]
        echo["distance"] = sensor.range_m
        echo["speed"] = sensor.range_m
        echo["id"] = -1
    first_column, last_column = cell_columns(grid, ego["x"], sensor.range_m)
    first_row, last_row = cell_rows(grid, ego["y"], sensor.range_m)
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = grid.bodies[b]
            if body["row"] != i and abs(body["z"] - ego["z"]) <= LEVEL_HEIGHT_M:
                _trace(ego, ego_cos, ego_sin, body, sensor)
    for k in range(sensor.cells):
        out[sensor.at + 2 * k] = sensor.echoes[k]["distance"] / sensor.scale
        out[sensor.at + 2 * k + 1] = sensor.echoes[k]["speed"] / sensor.scale
