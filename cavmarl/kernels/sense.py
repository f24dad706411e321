"""The end of a step: observations, terms and rewards of all agents of all worlds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import Outputs, RoadArrays, Sensors, Travel, Worlds
from cavmarl.kernels.codes import DRIVER_AGENT, EVENTS_THAT_END
from cavmarl.kernels.neighbors import Grid, fill_grid
from cavmarl.kernels.observing import (
    observe_ego,
    observe_lidar,
    observe_neighbors,
    observe_route,
    observe_signal,
)
from cavmarl.kernels.observing_lanes import observe_lanes
from cavmarl.kernels.stacking import has_entered, newest_frame, shift_frames
from cavmarl.kernels.terms import NUM_TERMS, write_terms

__all__ = ["sense"]


@kernel
def sense(
    roads: RoadArrays,
    plans: NDArray[np.void],
    travel: Travel,
    worlds: Worlds,
    grid: Grid,
    sensors: Sensors,
    weights: NDArray[np.float64],
    team_share: float,
    tick_s: float,
    ticks_per_step: int,
    chosen: NDArray[np.bool_],
    outputs: Outputs,
) -> None:
    """Write what every agent of the chosen worlds gets, at its own index.

    A vehicle that entered during the step has not acted: it is observed, its terms and reward are
    0, and it does not end. `observe_further` and `fill_stacks` complete the observations.

    Args:
        roads: the road arrays.
        plans: PLAN (G, L), the ways of agents.
        travel: the ways of all.
        worlds: committed rows at the end of the step; episode_return of agents' rows is written.
        grid: room for the spatial index of one world.
        sensors: settings and room.
        weights: (NUM_TERMS,) of the reward.
        team_share: share of the reward that is the mean over the agents that acted.
        tick_s: seconds a tick.
        ticks_per_step: ticks a step.
        chosen: (W,) which worlds.
        outputs: overwritten where chosen.
    """
    step_s = tick_s * ticks_per_step
    for w in range(worlds.ticks.shape[0]):
        if not chosen[w]:
            continue
        rows = worlds.rows[w]
        outputs.terms[w] = 0.0
        outputs.rewards[w] = 0.0
        outputs.terminated[w] = False
        outputs.present[w] = False
        outputs.acted[w] = False
        outputs.events[w] = 0
        outputs.vehicle_ids[w] = -1
        fill_grid(rows, worlds.num_rows[w], grid)
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if row["driver"] != DRIVER_AGENT:
                continue
            agent = row["agent"]
            seen = outputs.observations[w, agent]
            shift_frames(seen, sensors.stack, sensors.cleared)
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
        for agent in range(outputs.present.shape[1]):
            if not outputs.present[w, agent]:
                outputs.observations[w, agent] = 0.0
        _reward(worlds, w, weights, team_share, outputs)


@kernel
def _reward(
    worlds: Worlds, w: int, weights: NDArray[np.float64], team_share: float, outputs: Outputs
) -> None:
    """Weighted sums of the terms, mixed with the team's mean; summed in agent order."""
    team = 0.0
    acted = 0
    for agent in range(outputs.rewards.shape[1]):
        if outputs.acted[w, agent]:
            own = 0.0
            for k in range(NUM_TERMS):
                own += weights[k] * outputs.terms[w, agent, k]
            outputs.rewards[w, agent] = own
            team += own
            acted += 1
    if acted == 0:
        return
    team /= acted
    for agent in range(outputs.rewards.shape[1]):
        if outputs.acted[w, agent]:
            own = outputs.rewards[w, agent]
            outputs.rewards[w, agent] = (1.0 - team_share) * own + team_share * team
    rows = worlds.rows[w]
    for i in range(worlds.num_owned[w]):
        if rows[i]["driver"] == DRIVER_AGENT:
            rows[i]["episode_return"] += outputs.rewards[w, rows[i]["agent"]]
