"""highway-env's `LidarObservation`: distance and radial speed in sectors around the vehicle."""

from __future__ import annotations

import numpy as np

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.kernels.highway_lidar import LidarCells, cell_directions
from cavmarl.sensors.kernels.lidar_2d import ECHO
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor
from cavmarl.sensors.observed.highway import MAX_RELATIVE_MPS

# Within a body, distances are negative, down to minus the body's length.
LONGEST_BODY_M = 30.0


def features(config: SensorsConfig) -> list[Feature]:
    """List the distance and speed of each cell in turn."""
    lidar = config.lidar_observation
    scale = _scale(config)
    reach = lidar.maximum_range_m / scale
    inside = max(lidar.maximum_range_m, LONGEST_BODY_M) / scale
    speed = max(MAX_RELATIVE_MPS, lidar.maximum_range_m) / scale
    found = []
    for cell in range(lidar.cells):
        where = f"{cell * 360.0 / lidar.cells:g}° clockwise from east"
        found += [
            Feature(
                f"distance_{cell}",
                f"distance {where}; the range if the cell is empty",
                f"{scale:g} m",
                -inside,
                reach,
            ),
            Feature(
                f"speed_{cell}",
                f"radial speed of the object {where} relative to ego, positive away; "
                "the range if the cell is empty",
                f"{scale:g} m/s",
                -speed,
                speed,
            ),
        ]
    return found


def shape(config: SensorsConfig) -> tuple[int, ...]:
    return config.lidar_observation.cells, 2


def reach_m(config: SensorsConfig) -> float:
    lidar = config.lidar_observation
    return lidar.maximum_range_m if lidar.cells else 0.0


def settings(config: SensorsConfig, at: int) -> LidarCells:
    lidar = config.lidar_observation
    return LidarCells(
        at=at,
        cells=lidar.cells,
        range_m=lidar.maximum_range_m,
        scale=_scale(config),
        directions=cell_directions(lidar.cells),
        echoes=np.zeros(lidar.cells, dtype=ECHO),
    )


def _scale(config: SensorsConfig) -> float:
    lidar = config.lidar_observation
    return lidar.maximum_range_m if lidar.normalize else 1.0


def reads(config: SensorsConfig) -> list[Reading]:
    own = config.lidar_observation
    what = f"the nearest vehicle and its speed in {own.cells} sectors of {own.maximum_range_m:g} m"
    return [Reading("ideal sensors", f"{what}; buildings hide nothing")]


# Left and right cannot be exchanged: each cell extends only clockwise from its direction.
SENSOR = Sensor(
    "lidar_observation",
    features,
    reach_m,
    shape,
    settings=lambda made: settings(made.config, made.at),
    reads=reads,
)
