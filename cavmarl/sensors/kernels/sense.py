"""The end of a step: what the agents of one shard observe, and their terms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import Grid, fill_grid
from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Outputs, RoadArrays, Sensors, Travel, Worlds
from cavmarl.core.records.codes import DRIVER_AGENT, EVENTS_THAT_END
from cavmarl.rewards.kernels.terms import write_terms
from cavmarl.sensors.kernels.observing import (
    observe_ego,
    observe_lidar,
    observe_neighbors,
    observe_route,
    observe_signal,
)
from cavmarl.sensors.kernels.observing_lanes import observe_lanes
from cavmarl.sensors.kernels.stacking import has_entered, newest_frame, shift_frames


@kernel
def sense(
    roads: RoadArrays,
    plans: NDArray[np.void],
    travel: Travel,
    worlds: Worlds,
    grid: Grid,
    sensors: Sensors,
    tick_s: float,
    ticks_per_step: int,
    chosen: NDArray[np.bool_],
    outputs: Outputs,
) -> None:
    """Write what every owned agent of the chosen worlds gets, at its own index.

    A vehicle that entered during the step has not acted: it is observed, its terms are 0, and it
    does not end. `observe_optional` and `fill_stacks` complete the observations,
    `kernels.outputs` does what concerns the agents of all shards.

    `worlds`: committed rows at the end of the step, ghosts among them. `outputs`: cleared where
    chosen; written at the indices of owned agents.
    """
    step_s = tick_s * ticks_per_step
    for w in range(worlds.ticks.shape[0]):
        if not chosen[w]:
            continue
        rows = worlds.rows[w]
        is_filled = False  # many zones have no agents
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if row["driver"] != DRIVER_AGENT:
                continue
            if not is_filled:
                fill_grid(rows, worlds.num_rows[w], grid)
                is_filled = True
            agent = row["agent"]
            seen = outputs.observations[w, agent]
            shift_frames(seen, sensors.stack)
            out = seen[newest_frame(seen, sensors.stack) :]
            if sensors.ego:
                observe_ego(roads, plans, row, out)
            observe_route(roads, plans, row, sensors, out)
            observe_neighbors(rows, i, grid, sensors, out)
            phase = worlds.signal_phase[w]
            if sensors.signal:
                time = worlds.ticks[w] * tick_s
                controllers = worlds.controllers[w]
                observe_signal(roads, plans, controllers, row, phase, time, tick_s, sensors, out)
            observe_lanes(roads, travel, rows, i, grid, phase, sensors, out)
            observe_lidar(rows, i, grid, sensors, out)
            outputs.present[w, agent] = True
            outputs.vehicle_ids[w, agent] = row["id"]
            if has_entered(row, ticks_per_step):
                continue
            write_terms(roads, rows, i, grid, step_s, outputs.terms[w, agent])
            outputs.acted[w, agent] = True
            outputs.terminated[w, agent] = row["events"] & EVENTS_THAT_END != 0
            outputs.events[w, agent] = row["events"]
