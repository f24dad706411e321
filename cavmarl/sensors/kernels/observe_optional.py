"""Sensors that most environments leave off: highway-env's and the map-independent sensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.neighbors import Grid, fill_grid
from cavmarl.core.records.arrays import LaneGrid, RoadArrays, TripTables, Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.roads.kernels.lanes_now import roads_in, shares_lanes
from cavmarl.sensors.kernels.frame_stacks import has_entered, newest_frame
from cavmarl.sensors.kernels.highway_lidar import LidarCells, observe_lidar_cells
from cavmarl.sensors.kernels.kinematics_observation import KinematicsSensor, observe_kinematics
from cavmarl.sensors.kernels.observing_conflicts import (
    ConflictsSensor,
    forget_others,
    observe_conflicts,
)
from cavmarl.sensors.kernels.observing_history import HistorySensor, observe_history
from cavmarl.sensors.kernels.observing_way import WaySensor, observe_way
from cavmarl.sensors.kernels.occupancy import OccupancyGrid, observe_occupancy


class OptionalSensors(NamedTuple):
    """The settings of each optional sensor, by its name in `sensors.observed.SENSORS`.

    They are not part of `arrays.Sensors`, so that `sense` does not unpack sensors that are off.
    """

    kinematics: KinematicsSensor
    occupancy_grid: OccupancyGrid
    lidar_observation: LidarCells
    way: WaySensor
    conflicts: ConflictsSensor
    history: HistorySensor


@kernel
def observe_optional_frame(
    roads: RoadArrays,  # roads of the world
    travel: TripTables,
    lane_grid: LaneGrid,
    rows: NDArray[np.void],
    i: int,
    grid: Grid,
    controllers: NDArray[np.void],
    phase: NDArray[np.int32],
    reports: NDArray[np.void],  # REPORT (N,), the vehicle's inbox; N is 0 without messages
    tick: int,
    tick_s: float,
    entered: bool,  # whether the vehicle entered during the last step
    optional: OptionalSensors,
    out: NDArray[np.float32],
) -> None:
    """Write the features of the optional sensors of row i to a frame."""
    kinematics = optional.kinematics
    occupancy_grid = optional.occupancy_grid
    lidar_observation = optional.lidar_observation
    way = optional.way
    conflicts = optional.conflicts
    history = optional.history
    row = rows[i]
    if kinematics.vehicles > 0:
        observe_kinematics(roads, rows, i, grid, kinematics, out)
    if occupancy_grid.features.size > 0:
        observe_occupancy(roads, lane_grid, rows, i, grid, occupancy_grid, out)
    if lidar_observation.cells > 0:
        observe_lidar_cells(rows, i, grid, lidar_observation, out)
    if way.distances_m.size > 0 or way.lines > 0:
        time = tick * tick_s
        observe_way(roads, travel, controllers, row, phase, time, tick_s, way, out)
    if conflicts.most > 0:
        observe_conflicts(
            roads, travel, rows, i, grid, phase, reports, tick, tick_s, conflicts, out
        )
    if history.size > 0:
        observe_history(row, entered, history.at, history.size, out)


@kernel
def observe_optional(
    roads: RoadArrays,
    travel: TripTables,
    lane_grid: LaneGrid,
    worlds: Worlds,
    grid: Grid,
    optional: OptionalSensors,
    objects: NDArray[np.void],
    tick_s: float,
    ticks_per_step: int,
    stack: int,
    chosen: NDArray[np.bool_],
    observations: NDArray[np.float32],
) -> None:
    """Write the optional sensors' parts of every agent's newest frame in the chosen worlds.

    `optional`: settings and scratch; sensors that are off write nothing. `objects`: REPORT (W, A or
    more, N), the vehicles' inboxes; N is 0 without messages. `observations`: (W, A, D), whose
    optional parts are 0 before the call.
    """
    for w in range(chosen.size):
        if not chosen[w]:
            continue
        rows = worlds.rows[w]
        here = roads if shares_lanes(worlds.lanes) else roads_in(roads, worlds.lanes, w)
        is_filled = False  # fill the grid on first use: many zones have no agents
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if row["driver"] != DRIVER_AGENT:
                continue
            if not is_filled:
                fill_grid(rows, worlds.num_rows[w], grid)
                forget_others(optional.conflicts)
                is_filled = True
            seen = observations[w, row["agent"]]
            out = seen[newest_frame(seen, stack) :]
            observe_optional_frame(
                here,
                travel,
                lane_grid,
                rows,
                i,
                grid,
                worlds.controllers[w],
                worlds.signal_phase[w],
                objects[w, row["agent"]],
                worlds.ticks[w],
                tick_s,
                has_entered(row, ticks_per_step),
                optional,
                out,
            )
