"""Settings, scratch and tables of the sensors that environments switch on for agents.

Each one's kernel says what the fields mean; `at` is where the sensor writes in a frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.walls import Walls
from cavmarl.core.records import record


class KinematicsSensor(NamedTuple):
    """highway-env's `Kinematics`: see `kernels.kinematics_observation`."""

    at: int
    vehicles: int  # rows, the own one included; 0: off
    features: NDArray[np.int64]  # (F,) FEATURE_* codes, the columns
    ranges: NDArray[np.float64]  # (NUM_VEHICLE_FEATURES, 2) what becomes [-1, 1]; nan: left as is
    absolute: bool
    shuffled: bool
    clip: bool
    see_behind: bool
    observe_intentions: bool
    destinations: NDArray[np.float64]  # (M, G, 2) where each goal of each map is, m
    near_body: NDArray[np.int64]  # (vehicles,) scratch
    near_key: NDArray[np.float64]
    values: NDArray[np.float64]  # (NUM_VEHICLE_FEATURES,) scratch


class OccupancyGrid(NamedTuple):
    """highway-env's `OccupancyGrid`: see `kernels.occupancy`."""

    at: int
    features: NDArray[np.int64]  # (F,) FEATURE_* codes, the layers; none: off
    ranges: NDArray[np.float64]  # (NUM_VEHICLE_FEATURES, 2) what becomes [-1, 1]; nan: left as is
    min_x: float
    min_y: float
    step_x: float
    step_y: float
    num_x: int
    num_y: int
    radius_m: float  # of a circle around the vehicle that holds the grid
    aligned: bool
    clip: bool
    as_image: bool
    destinations: NDArray[np.float64]  # (M, G, 2) where each goal of each map is, m
    cell_body: NDArray[np.int64]  # (num_x * num_y,) scratch
    lane_seen: NDArray[np.int64]  # (L + 1,) scratch: when each lane was drawn last, and the time
    values: NDArray[np.float64]  # (NUM_VEHICLE_FEATURES,) scratch


class LidarCells(NamedTuple):
    """highway-env's `LidarObservation`: see `kernels.highway_lidar`."""

    at: int
    cells: int  # 0: off
    range_m: float
    scale: float  # what distances and speeds are divided by
    directions: NDArray[np.float64]  # (cells, 2) cosine and sine of the middle of each cell
    echoes: NDArray[np.void]  # ECHO (cells,) scratch


RANKED = record(
    ("counts", np.float64),  # m, what it is ranked by
    ("near", np.float64),  # m, the gap of its approach
    ("when", np.float64),  # s until then
    ("id", np.int64),
    ("body", np.int64),  # position in `Grid.bodies`; -1 - k: `ConflictsSensor.told[k]`
)


class WaySensor(NamedTuple):
    """The way ahead: see `kernels.observing_way`."""

    at: int
    distances_m: NDArray[np.float64]  # (P,) of the places that are told, rising
    lines: int  # stop lines that are told
    range_m: float  # up to where
    timing: bool


class ConflictsSensor(NamedTuple):
    """Vehicles that come near the own way: see `kernels.observing_conflicts`."""

    at: int
    most: int  # vehicles that are told; 0: off
    range_m: float
    walls: Walls  # that hide others
    heard: bool  # whether messages tell of those that are not seen
    told: NDArray[np.void]  # BODY (inbox,) scratch: those that messages tell of, where they are now
    indicators: bool  # whether others show their way over the next junction
    looks: NDArray[np.float64]  # (NUM_LOOKS, 4) scratch: where the own vehicle will be,
    heard_looks: NDArray[np.float64]  # (NUM_LOOKS, 4) one that a message tells of,
    others: NDArray[np.float64]  # (capacity, NUM_LOOKS, 4) and those in `Grid.bodies`
    indicated: NDArray[np.float64]  # (capacity,) the turn that each indicates: 1 left, -1 right
    foreseen: NDArray[np.int64]  # (capacity,) at which filling of the grid these were written
    filling: NDArray[np.int64]  # (1,) which one it is now
    ranked: NDArray[np.void]  # RANKED (count,) scratch


class HistorySensor(NamedTuple):
    """What the vehicle did before: see `kernels.observing_history`."""

    at: int
    size: int  # numbers; 0: off


class OptionalSensors(NamedTuple):
    """All of them; apart from `arrays.Sensors`, so that `sense` need not unpack what is off."""

    kinematics: KinematicsSensor
    occupancy: OccupancyGrid
    lidar_cells: LidarCells
    way: WaySensor
    conflicts: ConflictsSensor
    history: HistorySensor
