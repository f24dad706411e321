"""highway-env's `OccupancyGridObservation`: layers of cells around a vehicle.

A cell shows the vehicle whose centre lies in it, or the vehicle with the smallest id if there are
several. Positions and velocities are relative to the ego vehicle, which is also in the grid.
`on_road` marks the cells that contain a waypoint of a lane's centre line.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cosine, sine
from cavmarl.core.math.geometry import project
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M, Grid, cell_columns, cell_rows
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import LaneGrid, RoadArrays
from cavmarl.sensors.kernels.kinematics_observation import (
    FEATURE_ON_ROAD,
    in_range,
    make_relative,
    vehicle_features,
)

# highway-env sets waypoints up to this distance along a lane, from the point beside the vehicle.
LANE_REACH_M = 100.0


class OccupancyGrid(NamedTuple):
    """Settings and scratch of highway-env's `OccupancyGrid`."""

    at: int
    features: NDArray[np.int64]  # (F,) FEATURE_* codes, the layers; none: off
    ranges: NDArray[np.float64]  # (len(VEHICLE_FEATURES), 2) mapped to [-1, 1]; nan: not mapped
    min_x: float
    min_y: float
    step_x: float
    step_y: float
    num_x: int
    num_y: int
    radius_m: float  # radius of a circle around the vehicle that contains the grid
    aligned: bool
    clip: bool
    as_image: bool
    destinations: NDArray[np.float64]  # (M, G, 2) position of each goal of each map, m
    cell_body: NDArray[np.int64]  # (num_x * num_y,) scratch
    lane_seen: NDArray[np.int64]  # (L + 1,) scratch: last drawing of each lane; number of drawings
    values: NDArray[np.float64]  # (len(VEHICLE_FEATURES),) scratch


@kernel
def _cell(sensor: OccupancyGrid, ego: np.void, x: float, y: float) -> int:
    """Return the cell of a point, column (along x) · num_y + row (along y), or -1 outside."""
    right = x - ego["x"]
    down = ego["y"] - y
    if sensor.aligned:
        cos = cosine(ego["heading"])
        sin = -sine(ego["heading"])
        right, down = cos * right + sin * down, cos * down - sin * right
    column = math.floor((right - sensor.min_x) / sensor.step_x)
    row = math.floor((down - sensor.min_y) / sensor.step_y)
    if 0 <= column < sensor.num_x and 0 <= row < sensor.num_y:
        return int(column * sensor.num_y + row)
    return -1


@kernel
def _level(sensor: OccupancyGrid, value: float) -> float:
    """Return the value of a cell, clipped and, for images, scaled."""
    if sensor.clip or sensor.as_image:
        value = clamp(value, -1.0, 1.0)
    if sensor.as_image:
        return float(math.floor((value + 1.0) / 2.0 * 255.0))
    return value


@kernel
def _find_bodies(ego: np.void, grid: Grid, sensor: OccupancyGrid) -> None:
    """Fill `cell_body` with the vehicle that each cell shows; -1: none."""
    sensor.cell_body[:] = -1
    first_column, last_column = cell_columns(grid, ego["x"], sensor.radius_m)
    first_row, last_row = cell_rows(grid, ego["y"], sensor.radius_m)
    for j in range(first_row, last_row + 1):
        begin = grid.start[j * grid.num_x + first_column]
        end = grid.start[j * grid.num_x + last_column + 1]
        for b in range(begin, end):
            body = grid.bodies[b]
            cell = _cell(sensor, ego, body["x"], body["y"])
            if cell < 0 or abs(body["z"] - ego["z"]) > LEVEL_HEIGHT_M:
                continue
            shown = sensor.cell_body[cell]
            if shown < 0 or body["id"] < grid.bodies[shown]["id"]:
                sensor.cell_body[cell] = b


@kernel
def _draw_lane(
    roads: RoadArrays,
    lane: int,
    ego: np.void,
    sensor: OccupancyGrid,
    at: int,
    out: NDArray[np.float32],
) -> None:
    """Mark the cells that contain waypoints of one lane; waypoints are one cell width apart."""
    row = roads.lanes[lane]
    reach = sensor.radius_m
    if (
        row["min_x"] > ego["x"] + reach
        or row["max_x"] < ego["x"] - reach
        or row["min_y"] > ego["y"] + reach
        or row["max_y"] < ego["y"] - reach
    ):
        return
    first, num = row["first_point"], row["num_points"]
    beside, _, _, _ = project(roads.points, first, num, ego["x"], ego["y"])
    spacing = min(sensor.step_x, sensor.step_y)
    shown = _level(sensor, 1.0)
    segment = first
    before = -1.0
    for k in range(math.ceil(2.0 * LANE_REACH_M / spacing)):
        s = clamp(beside - LANE_REACH_M + k * spacing, 0.0, row["length_m"])
        if s == before:
            continue
        before = s
        while segment < first + num - 2 and roads.points[segment + 1]["s"] <= s:
            segment += 1
        point = roads.points[segment]
        along = s - point["s"]
        x = point["x"] + along * point["cos"]
        y = point["y"] + along * point["sin"]
        if abs(x - ego["x"]) > reach or abs(y - ego["y"]) > reach:
            continue
        if abs(point["z"] + along * point["slope"] - ego["z"]) > LEVEL_HEIGHT_M:
            continue
        cell = _cell(sensor, ego, x, y)
        if cell >= 0:
            out[at + cell] = shown


@kernel
def _draw_road(
    roads: RoadArrays,
    lane_grid: LaneGrid,
    ego: np.void,
    sensor: OccupancyGrid,
    at: int,
    out: NDArray[np.float32],
) -> None:
    seen = sensor.lane_seen
    now = seen.size - 1
    seen[now] += 1
    size = lane_grid.cell_m
    left = (ego["x"] - sensor.radius_m - lane_grid.min_x) / size
    right = (ego["x"] + sensor.radius_m - lane_grid.min_x) / size
    low = (ego["y"] - sensor.radius_m - lane_grid.min_y) / size
    high = (ego["y"] + sensor.radius_m - lane_grid.min_y) / size
    for j in range(max(math.floor(low), 0), min(math.floor(high), lane_grid.num_y - 1) + 1):
        for i in range(max(math.floor(left), 0), min(math.floor(right), lane_grid.num_x - 1) + 1):
            cell = j * lane_grid.num_x + i
            for k in range(lane_grid.cell_start[cell], lane_grid.cell_start[cell + 1]):
                lane = lane_grid.cell_lanes[k]
                if seen[lane] != seen[now]:
                    seen[lane] = seen[now]
                    _draw_lane(roads, lane, ego, sensor, at, out)


@kernel
def observe_occupancy(
    roads: RoadArrays,
    lane_grid: LaneGrid,
    rows: NDArray[np.void],
    i: int,
    grid: Grid,
    sensor: OccupancyGrid,
    out: NDArray[np.float32],
) -> None:
    """Write the layers of one vehicle, column by column along x; empty cells stay unchanged.

    `sensor`: settings and scratch, with cells and ranges in the frame of `vehicle_features`. `out`:
    an observation, which must be 0 from `sensor.at` on.
    """
    ego = rows[i]
    num_cells = sensor.num_x * sensor.num_y
    _find_bodies(ego, grid, sensor)
    for cell in range(num_cells):
        if sensor.cell_body[cell] < 0:
            continue
        shown = rows[grid.bodies[sensor.cell_body[cell]]["row"]]
        vehicle_features(roads.lanes, roads.points, shown, sensor.destinations, True, sensor.values)
        make_relative(sensor.values, ego)
        for layer in range(sensor.features.size):
            feature = sensor.features[layer]
            if feature != FEATURE_ON_ROAD:
                value = in_range(sensor.values[feature], sensor.ranges, feature)
                out[sensor.at + layer * num_cells + cell] = _level(sensor, value)
    for layer in range(sensor.features.size):
        if sensor.features[layer] == FEATURE_ON_ROAD:
            _draw_road(roads, lane_grid, ego, sensor, sensor.at + layer * num_cells, out)
