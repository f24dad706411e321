"""Vehicles that follow plans of their own world, because its lanes differ from the map."""

from __future__ import annotations

import math

import numpy as np

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import RoadArrays, TripTables, Worlds
from cavmarl.core.records.codes import DRIVER_BACKGROUND
from cavmarl.core.records.rows import is_steered
from cavmarl.driving.kernels.lanes.route_following import distance_left, own_step, route_time_s
from cavmarl.driving.kernels.motion.motion import STANDING_MPS
from cavmarl.roads.kernels.lanes_now import roads_in, shares_lanes
from cavmarl.traffic.kernels.way_requests import has_room


@kernel
def follows_plan(row: np.void) -> bool:
    """Return whether a vehicle drives to a goal of the generator."""
    drives = is_steered(row) or row["driver"] == DRIVER_BACKGROUND
    follows: bool = drives and row["order"] < 0
    return follows


@kernel
def prolong_trip(roads: RoadArrays, travel: TripTables, row: np.void) -> None:
    """Extend the time limit of an agent's trip if its present route takes longer from here."""
    if row["due"] < 0 or travel.trip_horizon <= 0.0 or roads.lanes[row["lane"]]["internal"]:
        return
    most_s = route_time_s(roads, travel, row, row["tick"] * travel.tick_s)
    row["due"] = max(row["due"], row["tick"] + math.ceil(most_s / travel.tick_s))


@kernel
def take_plan(roads: RoadArrays, travel: TripTables, row: np.void, w: int) -> int:
    """Put a vehicle on the present plan to its goal; return 1 if its route changes, else 0.

    A background vehicle that can no longer change to another link or lane keeps its plan until the
    next call. A longer route does not count as lost progress of an agent.

    `roads`: roads of world w. `row`: VEHICLE that follows a plan, written.
    """
    lane = row["lane"]
    way = row["goal"] * roads.lanes.shape[0] + travel.shifts[w]
    if way == row["way"]:
        return 0
    if row["driver"] == DRIVER_BACKGROUND and not roads.lanes[lane]["internal"]:
        if row["speed"] >= STANDING_MPS and not has_room(roads, travel, row, travel.steps, way):
            return 0
    before = travel.steps[own_step(roads, row)]["to_go"]
    row["way"] = way
    step = travel.steps[own_step(roads, row)]
    if step["to_go"] == before:
        return 0
    row["leg"] += 1
    to_go = distance_left(roads, row, step)
    if is_steered(row):
        row["step_to_go"] += to_go - row["to_go"]
        row["to_go"] = to_go
        prolong_trip(roads, travel, row)
    row["to_go"] = to_go
    return 1


@kernel
def renew_distances(roads: RoadArrays, travel: TripTables, worlds: Worlds, w: int) -> None:
    """Update the remaining distances of a world's agents after its plans have changed.

    `worlds`: the owned committed rows are written. Call before a step begins.
    """
    here = roads if shares_lanes(worlds.lanes) else roads_in(roads, worlds.lanes, w)
    for i in range(worlds.num_owned[w]):
        row = worlds.rows[w, i]
        if not is_steered(row) or row["way"] == row["goal"] * roads.lanes.shape[0]:
            continue
        to_go = distance_left(here, row, travel.steps[own_step(here, row)])
        if to_go != row["to_go"]:
            row["to_go"] = to_go
            prolong_trip(here, travel, row)
