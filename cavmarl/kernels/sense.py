"""The end of a step: observations, terms and rewards of all agents of all worlds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.arrays import Outputs, RoadArrays, Sensors, Worlds
from cavmarl.kernels.codes import DRIVER_AGENT, EVENTS_THAT_END
from cavmarl.kernels.neighbors import Grid, fill_grid
from cavmarl.kernels.observing import (
    observe_ego,
    observe_lidar,
    observe_neighbors,
    observe_route,
    observe_signal,
)
from cavmarl.kernels.terms import NUM_TERMS, write_terms

__all__ = ["sense"]


@kernel
def sense(
    roads: RoadArrays,
    plans: NDArray[np.void],
    worlds: Worlds,
    grid: Grid,
    sensors: Sensors,
    weights: NDArray[np.float64],
    team_share: float,
    step_s: float,
    outputs: Outputs,
) -> None:
    """Write what every agent gets, at its own index.

    Args:
        roads: the road arrays.
        plans: PLAN (G, L).
        worlds: committed rows at the end of the step; episode_return of agents' rows is written.
        grid: room for the spatial index of one world.
        sensors: settings and room.
        weights: (NUM_TERMS,) of the reward.
        team_share: share of the reward that is the mean over the agents present.
        step_s: seconds a step.
        outputs: overwritten.
    """
    for w in range(worlds.ticks.shape[0]):
        rows = worlds.rows[w]
        outputs.observations[w] = 0.0
        outputs.terms[w] = 0.0
        outputs.rewards[w] = 0.0
        outputs.terminated[w] = False
        outputs.present[w] = False
        outputs.events[w] = 0
        outputs.vehicle_ids[w] = -1
        fill_grid(rows, worlds.num_rows[w], grid)
        for i in range(worlds.num_owned[w]):
            row = rows[i]
            if row["driver"] != DRIVER_AGENT:
                continue
            agent = row["agent"]
            out = outputs.observations[w, agent]
            observe_ego(roads, plans, row, out)
            observe_route(roads, plans, row, sensors, out)
            observe_neighbors(rows, i, grid, sensors, out)
            observe_signal(roads, plans, row, worlds.signal_phase[w], sensors, out)
            observe_lidar(rows, i, grid, sensors, out)
            write_terms(roads, rows, i, grid, step_s, outputs.terms[w, agent])
            outputs.present[w, agent] = True
            outputs.terminated[w, agent] = row["events"] & EVENTS_THAT_END != 0
            outputs.events[w, agent] = row["events"]
            outputs.vehicle_ids[w, agent] = row["id"]
        _reward(worlds, w, weights, team_share, outputs)


@kernel
def _reward(
    worlds: Worlds, w: int, weights: NDArray[np.float64], team_share: float, outputs: Outputs
) -> None:
    """Weighted sums of the terms, mixed with the team's mean; summed in agent order."""
    team = 0.0
    present = 0
    for agent in range(outputs.rewards.shape[1]):
        if outputs.present[w, agent]:
            own = 0.0
            for k in range(NUM_TERMS):
                own += weights[k] * outputs.terms[w, agent, k]
            outputs.rewards[w, agent] = own
            team += own
            present += 1
    if present == 0:
        return
    team /= present
    for agent in range(outputs.rewards.shape[1]):
        if outputs.present[w, agent]:
            own = outputs.rewards[w, agent]
            outputs.rewards[w, agent] = (1.0 - team_share) * own + team_share * team
    rows = worlds.rows[w]
    for i in range(worlds.num_owned[w]):
        if rows[i]["driver"] == DRIVER_AGENT:
            rows[i]["episode_return"] += outputs.rewards[w, rows[i]["agent"]]
