"""highway-env's `OccupancyGrid`: layers of cells around the vehicle."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cavmarl.config.sensors import OccupancyGridConfig, SensorsConfig
from cavmarl.core.math.elementary import hypot
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.occupancy import OccupancyGrid
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides, hidden
from cavmarl.sensors.observed.highway import (
    NEGATED,
    codes,
    off_centre,
    range_table,
    vehicle_feature,
)

_DEFAULT_RANGES = {"vx": (-80.0, 80.0), "vy": (-80.0, 80.0)}


def features(config: SensorsConfig) -> list[Feature]:
    """List the features by layer, then column (west to east), then row (north to south)."""
    grid = config.occupancy_grid
    columns, rows = grid.shape
    ranges = grid.features_range or _DEFAULT_RANGES
    found = []
    for name in grid.features:
        for column in range(columns):
            for row in range(rows):
                label = f"{name}_{column}_{row}"
                subject = f"cell {column}, {row}"
                if name == "on_road":
                    feature = Feature(label, f"{subject}: 1 if it has a centre line", "", 0.0)
                else:
                    feature = vehicle_feature(name, label, f"vehicle in {subject}", ranges, False)
                found.append(_bounded(feature, grid))
    return found


def _bounded(feature: Feature, grid: OccupancyGridConfig) -> Feature:
    """Return the feature with the bounds and scale that result from clipping or images."""
    if grid.as_image:
        scale = f"255 is {feature.scale}" if feature.scale else "255 is 1"
        return Feature(feature.name, feature.meaning, scale, 0.0, 255.0)
    if grid.clip:
        low, high = max(feature.low, -1.0), min(feature.high, 1.0)
        return Feature(feature.name, feature.meaning, feature.scale, low, high)
    return feature


def shape(config: SensorsConfig) -> tuple[int, ...]:
    """Return (layers, columns along x, rows along y)."""
    return len(config.occupancy_grid.features), *config.occupancy_grid.shape


def dtype(config: SensorsConfig) -> DTypeLike:
    return np.uint8 if config.occupancy_grid.as_image else np.float32


def reach_m(config: SensorsConfig) -> float:
    """Return the distance to the furthest corner, or 0 if the sensor is off."""
    grid = config.occupancy_grid
    if not grid.features:
        return 0.0
    return hypot(*(max(abs(low), abs(high)) for low, high in grid.grid_size_m))


def settings(
    config: SensorsConfig, at: int, network: RoadNetwork, goals: NDArray[np.float64]
) -> OccupancyGrid:
    """Return the kernel's settings; `goals`: see `highway.goal_places`."""
    grid = config.occupancy_grid
    columns, rows = grid.shape
    table = range_table(grid.features_range or _DEFAULT_RANGES)
    return OccupancyGrid(
        at=at,
        features=codes(grid.features),
        ranges=table,
        min_x=grid.grid_size_m[0][0],
        min_y=grid.grid_size_m[1][0],
        step_x=grid.grid_step_m[0],
        step_y=grid.grid_step_m[1],
        num_x=columns,
        num_y=rows,
        radius_m=reach_m(config),
        aligned=grid.align_to_vehicle_axes,
        clip=grid.clip,
        as_image=grid.as_image,
        destinations=goals,
        cell_body=np.zeros(columns * rows, dtype=np.int64),
        lane_seen=np.zeros(len(network.lanes) + 1, dtype=np.int64),
        values=np.zeros(len(table)),
    )


def reads(config: SensorsConfig) -> list[Reading]:
    own = config.occupancy_grid
    what = f"vehicles within {reach_m(config):.0f} m, by cell; {hidden(through_walls=True)}"
    found = [Reading("ideal sensors", what)]
    if "on_road" in own.features:
        found.append(Reading("map", "the lanes around it"))
    if {"cos_d", "sin_d"} & set(own.features):
        found.append(Reading("world's state", "the destinations of other vehicles"))
    return found


def _cell_on_other_side(config: SensorsConfig, name: str) -> str:
    where, row = name.rpartition("_")[::2]
    return f"{where}_{config.occupancy_grid.shape[1] - 1 - int(row)}"


def _refusal(config: SensorsConfig) -> str:
    grid = config.occupancy_grid
    (low, high), step = grid.grid_size_m[1], grid.grid_step_m[1]
    if low != -high or grid.shape[1] * step != high - low:
        return (
            f"left and right cannot be exchanged, because the grid from {low:g} m to {high:g} m "
            f"with cells of {step:g} m is not symmetric"
        )
    if grid.as_image and set(NEGATED) & set(grid.features):
        return "left and right cannot be exchanged, because as_image rounds the values"
    return off_centre(grid.features_range, grid.features)


SENSOR = Sensor(
    "occupancy_grid",
    features,
    reach_m,
    shape,
    dtype,
    settings=lambda made: settings(made.config, made.at, made.network, made.goals),
    reads=reads,
    sides=Sides(NEGATED, _cell_on_other_side, _refusal),
)
