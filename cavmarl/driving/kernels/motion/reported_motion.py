"""Rows whose motion another simulator reports: points to steer to, lane positions, and rates.

A row first moves as cavmarl would move it, and is corrected only if the report differs. So a
simulator that moves vehicles exactly as cavmarl does changes no bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.geometry import lane_pose, project_near, wrap_angle
from cavmarl.core.math.scalars import clamp
from cavmarl.core.records.arrays import LaneGrid, RoadArrays, TripTables
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    EVENT_ARRIVED,
    EVENT_OUT_OF_TIME,
    EVENT_RED_LIGHT,
    EVENTS_THAT_END,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
)
from cavmarl.driving.kernels.junctions.gaps import link_signal
from cavmarl.driving.kernels.lanes.route_following import next_step
from cavmarl.driving.kernels.motion.motion import ARRIVE_M, MAX_SPEED_MPS, STANDING_MPS
from cavmarl.driving.kernels.motion.tracking import WINDOW_M, locate, side_lane
from cavmarl.roads.kernels.lanes_now import plans_of

AIM_S = 0.6  # driving time from a vehicle to the point that it aims at
AIM_MIN_M = 4.0
AIM_LANES = 8  # largest number of lanes between a vehicle and its aim


@kernel
def find_aims(
    roads: RoadArrays,
    travel: TripTables,
    places: NDArray[np.int64],  # (n,) rows
    rows: NDArray[np.void],  # VEHICLE (C,)
    aims: NDArray[np.float64],  # (n, 2) x and y, overwritten; NaN for agents
) -> None:
    """Find, for each vehicle, the point ahead on its path's centre line to which it steers."""
    for k in range(places.shape[0]):
        row = rows[places[k]]
        if row["driver"] == DRIVER_AGENT:
            aims[k, 0] = aims[k, 1] = math.nan
            continue
        lane = row["lane"]
        way = row["way"]
        s = row["s"] + max(AIM_S * row["speed"], AIM_MIN_M)
        for _ in range(AIM_LANES):
            length = roads.lanes[lane]["length_m"]
            if s <= length:
                break
            following, way, _ = next_step(roads, travel, lane, way)
            if following < 0:
                break
            s -= length
            lane = following
        here = roads.lanes[lane]
        x, y, _, _, _, _ = lane_pose(roads.points, here["first_point"], here["num_points"], s)
        aims[k, 0] = x
        aims[k, 1] = y


@inlined_kernel
def is_as_reported(row: np.void, told: np.void) -> bool:
    same: bool = (
        row["x"] == told["x"]
        and row["y"] == told["y"]
        and row["heading"] == told["heading"]
        and row["speed"] == told["speed"]
    )
    return same


@inlined_kernel
def _take_report(row: np.void, was: np.void, told: np.void, dt: float) -> None:
    """Copy a report to a row and compute the rates that depend on the report."""
    row["x"] = told["x"]
    row["y"] = told["y"]
    row["heading"] = wrap_angle(told["heading"])
    row["speed"] = clamp(told["speed"], 0.0, MAX_SPEED_MPS)
    row["accel"] = (row["speed"] - was["speed"]) / dt
    row["jerk"] = (row["accel"] - was["accel"]) / dt
    row["yaw_rate"] = wrap_angle(row["heading"] - was["heading"]) / dt
    row["wait_s"] = was["wait_s"] + dt if row["speed"] < STANDING_MPS else 0.0
    row["step_jerk"] = was["step_jerk"] + abs(row["jerk"]) * dt


@kernel
def _correct_background(
    roads: RoadArrays, row: np.void, was: np.void, told: np.void, dt: float
) -> None:
    """Correct the vehicle's lane position by the difference between the report and the row."""
    lane = roads.lanes[row["lane"]]
    first = lane["first_point"]
    num = lane["num_points"]
    s, d, _, _ = project_near(roads.points, first, num, row["x"], row["y"], row["s"], WINDOW_M)
    new_s, new_d, _, _ = project_near(
        roads.points, first, num, told["x"], told["y"], row["s"], WINDOW_M
    )
    _take_report(row, was, told, dt)
    new_s = clamp(row["s"] + new_s - s, 0.0, lane["length_m"])
    row["to_go"] -= new_s - row["s"]
    row["s"] = new_s
    row["d"] += new_d - d
    row["side_lane"] = side_lane(roads, row)


@kernel
def _correct_agent(
    roads: RoadArrays,
    plans: NDArray[np.void],
    grid: LaneGrid,
    row: np.void,
    was: np.void,
    told: np.void,
    phase: NDArray[np.int32],
    dt: float,
) -> None:
    """Find the vehicle's position on the lanes again, as after `move_agent`."""
    _take_report(row, was, told, dt)
    row["lane"] = was["lane"]
    row["s"] = was["s"]
    row["d"] = was["d"]
    row["link"] = was["link"]
    events = was["events"] | (row["events"] & EVENT_OUT_OF_TIME)
    events |= locate(roads, plans, grid, row)
    if row["link"] != was["link"] and row["link"] >= 0:
        signal = link_signal(roads, row["link"], phase)
        if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW:
            events |= EVENT_RED_LIGHT
    row["side_lane"] = side_lane(roads, row)
    row["to_go"] = plans[row["goal"], row["lane"]]["to_go"] - row["s"]
    if row["to_go"] <= ARRIVE_M:
        events |= EVENT_ARRIVED
    row["events"] = events


@kernel
def follow_reports(
    roads: RoadArrays,
    plans: NDArray[np.void],  # PLAN (V, G, L), see `plans_of`
    w: int,  # the world
    grid: LaneGrid,  # the lanes near each place
    places: NDArray[np.int64],  # (n,) rows to correct
    was: NDArray[np.void],  # VEHICLE (n,), the rows at `places` before the tick
    told: NDArray[np.void],  # MOTION (n,), the reports for the rows at `places`
    rows: NDArray[np.void],  # VEHICLE (C,), as cavmarl has moved them; updated
    phase: NDArray[np.int32],  # (num_signals,) active PHASE rows
    dt: float,  # length of the tick, s
) -> None:
    """Correct the rows that differ from the reports."""
    for k in range(places.shape[0]):
        row = rows[places[k]]
        if is_as_reported(row, told[k]):
            continue
        if row["driver"] == DRIVER_AGENT:
            if was[k]["events"] & EVENTS_THAT_END:
                continue  # the trip is over, so the vehicle does not move
            own_plans = plans[plans_of(plans, row, w)]
            _correct_agent(roads, own_plans, grid, row, was[k], told[k], phase, dt)
        else:
            _correct_background(roads, row, was[k], told[k], dt)
