"""What followers see of a world: which of their vehicles are in it, and what their sensors have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.cav_env import CavEnv
from cavmarl.followers.messages import ArrayView, Snapshot, VehicleView
from cavmarl.roads.network import VEHICLE_CLASSES

__all__ = ["Moment", "take_snapshot"]


class Moment(NamedTuple):
    """When a snapshot is taken.

    Attributes:
        frame: its number.
        episode: goes up with each reset.
        tick: of the world, since its reset.
        is_over: the episode has ended.
    """

    frame: int
    episode: int
    tick: int
    is_over: bool


def take_snapshot(
    env: CavEnv, agents: Sequence[int], moment: Moment
) -> tuple[Snapshot, list[NDArray[Any]]]:
    """What a follower is sent.

    Args:
        env: the world, in this process.
        agents: indices of the follower's.
        moment: when that is.

    Returns:
        the message, and its arrays.
    """
    worlds = env.worlds.arrays
    due = [k for k in agents if worlds.mask[0, k] and not moment.is_over]
    vehicles: dict[str, VehicleView] = {}
    views: list[ArrayView] = []
    arrays: list[NDArray[Any]] = []
    if due:
        rows = env.simulation.vehicles()
        by_agent = {int(row["agent"]): row for row in rows[np.isin(rows["agent"], due)]}
        for k in due:
            name = env.possible_agents[k]
            vehicles[name] = _view(env, by_agent[k])
            seen = worlds.observations[0, k : k + 1]
            views.append(_array_view(name, "observation", seen, [moment.tick]))
            arrays.append(np.ascontiguousarray(seen))
    time_s = moment.tick * env.config.clock.sim_dt_s
    return Snapshot(
        moment.frame, moment.episode, moment.tick, time_s, moment.is_over, vehicles, views
    ), arrays


def _array_view(vehicle: str, name: str, array: NDArray[Any], ticks: list[int]) -> ArrayView:
    return ArrayView(vehicle, name, array.dtype.str, list(array.shape), ticks)


def _view(env: CavEnv, row: np.void) -> VehicleView:
    network, simulation = env.network, env.simulation
    edge = int(simulation.goal_edges[row["goal"]])
    lane = int(network.edges["first_lane"][edge])
    end = network.lane_polyline(lane)[-1]
    vclass = int(simulation.types[row["vtype"]]["vclass"])
    return VehicleView(
        vehicle_id=int(row["id"]),
        vclass=VEHICLE_CLASSES[vclass],
        length_m=float(row["length"]),
        width_m=float(row["width"]),
        goal_edge=network.edge_ids[edge],
        goal_m=[float(end[0]), float(end[1])],
    )
