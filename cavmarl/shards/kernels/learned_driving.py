"""Background vehicles that neural networks drive: their observations, and the commands of a step.

The same kernels make the observations as for agents' vehicles. A network's memory of earlier steps
is in the vehicle's record, so the memory moves with the vehicle from zone to zone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.neighbors import Grid, fill_grid
from cavmarl.core.records.arrays import LaneGrid, RoadArrays, Sensors, TripTables, Worlds
from cavmarl.core.records.codes import DRIVER_LEARNED
from cavmarl.networks.kernels.inference import TILE_ROWS, evaluate_network
from cavmarl.roads.kernels.lanes_now import plans_of, roads_in, shares_lanes
from cavmarl.sensors.kernels.frame_stacks import has_entered
from cavmarl.sensors.kernels.observe_optional import OptionalSensors, observe_optional_frame
from cavmarl.sensors.kernels.observing_conflicts import forget_others
from cavmarl.sensors.kernels.observing_history import HISTORY_FEATURES
from cavmarl.sensors.kernels.sense import observe_frame


class LearnedDriver(NamedTuple):
    """A neural network that drives background vehicles, and the settings of their sensors."""

    number: int  # VTYPE["network"] of its vehicles
    sensors: Sensors
    optional: OptionalSensors
    layers: NDArray[np.int64]  # the network, see `networks.kernels.inference`
    weights: NDArray[np.float32]
    accel_mps2: float  # acceleration at the action 1
    steering_rad: float  # angle of the front wheels at the action 1
    # (D,) how to exchange left and right in the D numbers of an observation, see `exchanged_sides`;
    # (0,): not needed
    exchanged: NDArray[np.int64]
    signs: NDArray[np.float32]
    no_reports: NDArray[np.void]  # REPORT (0,), the empty inbox of each vehicle
    failed: NDArray[np.int64]  # (1,) id of a vehicle for which the network gave NaN; -1: none
    # scratch
    observations: NDArray[np.float32]  # (TILE_ROWS · D,)
    frame: NDArray[np.float32]  # (D,)
    actions: NDArray[np.float32]  # (TILE_ROWS · 2,)
    states: NDArray[np.float32]  # (0,)
    buffers: NDArray[np.float32]
    places: NDArray[np.int64]  # (TILE_ROWS,) rows that are observed


@inlined_kernel
def _recall(row: np.void, at: int, size: int, frame: NDArray[np.float32]) -> None:
    """Write the vehicle's memory to the part `history` of the frame, the last step first."""
    if size > HISTORY_FEATURES:
        frame[at] = row["throttle_1"]
        frame[at + 1] = row["steering_1"]
        frame[at + 2] = row["speed_1"]
    if size > 2 * HISTORY_FEATURES:
        frame[at + HISTORY_FEATURES] = row["throttle_2"]
        frame[at + HISTORY_FEATURES + 1] = row["steering_2"]
        frame[at + HISTORY_FEATURES + 2] = row["speed_2"]


@inlined_kernel
def _remember(row: np.void, at: int, size: int, frame: NDArray[np.float32]) -> None:
    """Keep the part of `history` that the next observation repeats."""
    if size > HISTORY_FEATURES:
        row["throttle_1"] = frame[at]
        row["steering_1"] = frame[at + 1]
        row["speed_1"] = frame[at + 2]
    if size > 2 * HISTORY_FEATURES:
        row["throttle_2"] = frame[at + HISTORY_FEATURES]
        row["steering_2"] = frame[at + HISTORY_FEATURES + 1]
        row["speed_2"] = frame[at + HISTORY_FEATURES + 2]


@inlined_kernel
def _exchange_sides(learned: LearnedDriver, frame: NDArray[np.float32]) -> None:
    """Exchange left and right in an observation, if the driver was trained on the other side."""
    if learned.exchanged.size == 0:
        return
    for k in range(frame.size):
        learned.frame[k] = frame[k]
    for k in range(frame.size):
        # The sum turns -0.0 into 0.0.
        frame[k] = learned.frame[learned.exchanged[k]] * learned.signs[k] + np.float32(0.0)


@kernel
def _act(rows: NDArray[np.void], num: int, learned: LearnedDriver) -> None:
    """Evaluate the network for the observed rows, and set their commands.

    If the network gives NaN, the command is 0 and `failed` is set.
    """
    width = learned.observations.shape[0] // TILE_ROWS
    evaluate_network(
        learned.layers,
        learned.weights,
        learned.observations[: num * width],
        learned.states,
        learned.buffers,
        learned.actions[: 2 * num],
    )
    for k in range(num):
        row = rows[learned.places[k]]
        if math.isnan(learned.actions[2 * k]) or math.isnan(learned.actions[2 * k + 1]):
            learned.failed[0] = row["id"]
            learned.actions[2 * k] = np.float32(0.0)
            learned.actions[2 * k + 1] = np.float32(0.0)
        row["throttle"] = np.float64(learned.actions[2 * k]) * learned.accel_mps2
        steering = learned.actions[2 * k + 1]
        if learned.exchanged.size > 0:
            steering = np.float32(0.0) - steering
        row["steering"] = np.float64(steering) * learned.steering_rad


@kernel
def drive_by_network(
    roads: RoadArrays,
    plans: NDArray[np.void],  # PLAN (V, goals, lanes); V as in `Worlds.lanes`
    travel: TripTables,
    lane_grid: LaneGrid,
    worlds: Worlds,  # outputs: throttle, steering and memory of the owned committed rows
    grid: Grid,
    learned: LearnedDriver,
    tick_s: float,
    ticks_per_step: int,
) -> None:
    """Set the commands of a step for all vehicles that one network drives.

    An observation reads data that this kernel writes for its own vehicle, but for no other vehicle.
    """
    width = learned.observations.shape[0] // TILE_ROWS
    history_at, history_size = learned.optional.history.at, learned.optional.history.size
    for w in range(worlds.ticks.shape[0]):
        rows = worlds.rows[w]
        here = roads if shares_lanes(worlds.lanes) else roads_in(roads, worlds.lanes, w)
        is_filled = False
        num = 0
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if row["driver"] != DRIVER_LEARNED:
                continue
            if travel.types[row["vtype"]]["network"] != learned.number:
                continue
            if not is_filled:
                fill_grid(rows, worlds.num_rows[w], grid)
                forget_others(learned.optional.conflicts)
                is_filled = True
            frame = learned.observations[num * width : (num + 1) * width]
            frame[:] = 0.0
            _recall(row, history_at, history_size, frame)
            observe_frame(
                here,
                plans[plans_of(plans, row, w)],
                travel,
                rows,
                i,
                grid,
                worlds.controllers[w],
                worlds.signal_phase[w],
                worlds.ticks[w],
                tick_s,
                learned.sensors,
                frame,
            )
            observe_optional_frame(
                here,
                travel,
                lane_grid,
                rows,
                i,
                grid,
                worlds.controllers[w],
                worlds.signal_phase[w],
                learned.no_reports,
                worlds.ticks[w],
                tick_s,
                has_entered(row, ticks_per_step),
                learned.optional,
                frame,
            )
            _remember(row, history_at, history_size, frame)
            _exchange_sides(learned, frame)
            learned.places[num] = i
            num += 1
            if num == TILE_ROWS:
                _act(rows, num, learned)
                num = 0
        if num > 0:
            _act(rows, num, learned)
