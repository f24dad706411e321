"""The end of a step: observations and reward terms of the agents of one shard.

One function per sensor writes the sensor's features, scaled to [-1, 1], starting at index `at`. The
scales are defined here; names and meanings of the features are in `sensors/observed/`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cos_sin
from cavmarl.core.math.geometry import lane_pose, wrap_angle
from cavmarl.core.math.neighbors import Grid, fill_grid, nearest_bodies
from cavmarl.core.math.scalars import clamp
from cavmarl.core.math.walls import is_cut
from cavmarl.core.records.arrays import Outputs, RoadArrays, Sensors, TripTables, Worlds
from cavmarl.core.records.codes import (
    DRIVER_AGENT,
    EVENTS_THAT_END,
    SIGNAL_GREEN_MAJOR,
    SIGNAL_GREEN_MINOR,
    SIGNAL_NONE,
    SIGNAL_OFF,
    SIGNAL_RED,
    SIGNAL_RED_YELLOW,
    SIGNAL_STOP_THEN_GO,
    SIGNAL_YELLOW_MAJOR,
    SIGNAL_YELLOW_MINOR,
)
from cavmarl.driving.kernels.junctions.gaps import link_signal, must_stop
from cavmarl.driving.kernels.junctions.signal_timing import time_to_change
from cavmarl.rewards.kernels.terms import write_terms
from cavmarl.roads.kernels.lanes_now import plans_of, roads_in, shares_lanes
from cavmarl.sensors.kernels.frame_stacks import has_entered, newest_frame, shift_frames
from cavmarl.sensors.kernels.lidar_2d import lidar
from cavmarl.sensors.kernels.observing_lanes import observe_lanes

EGO_FEATURES = 13
NEIGHBOR_FEATURES = 7
SIGNAL_FEATURES = 6  # the signal's timing adds two, then stop signs add one

SPEED_SCALE = 40.0  # m/s
ACCEL_SCALE = 10.0  # m/s²
STEERING_SCALE = math.pi / 4.0
YAW_SCALE = 1.0  # rad/s
OFFSET_SCALE = 4.0  # m
ROOM_SCALE = 200.0  # m
TO_GO_SCALE = 1000.0  # m
LENGTH_SCALE = 20.0  # m
WHEELBASE_SCALE = 10.0  # m
HALF_S = 5.0  # a time of this length has a soonness of 0.5
SLOWEST_MPS = 1.0  # the vehicle is assumed to approach at least this fast, even if stopped


@kernel
def unit(value: float) -> float:
    return clamp(value, -1.0, 1.0)


@kernel
def soonness(time: float) -> float:
    """Return the soonness of a time: 1 now, 0.5 in `HALF_S`, towards 0 in a long time."""
    return HALF_S / (HALF_S + time)


@kernel
def observe_ego(
    roads: RoadArrays, plans: NDArray[np.void], row: np.void, out: NDArray[np.float32]
) -> None:
    """Write the features of the vehicle, its lane, and the lane change that its plan needs."""
    lane = roads.lanes[row["lane"]]
    step = plans[row["goal"], row["lane"]]
    _, _, _, cos, sin, _ = lane_pose(
        roads.points, lane["first_point"], lane["num_points"], row["s"]
    )
    error = wrap_angle(row["heading"] - atan2(sin, cos))
    out[0] = unit(row["speed"] / SPEED_SCALE)
    out[1] = unit(row["accel"] / ACCEL_SCALE)
    out[2] = unit(row["steering"] / STEERING_SCALE)
    out[3] = unit(row["yaw_rate"] / YAW_SCALE)
    out[4] = unit(row["d"] / OFFSET_SCALE)
    out[5] = error / math.pi
    out[6] = unit(lane["speed_mps"] / SPEED_SCALE)
    out[7] = 1.0 if lane["left"] >= 0 else 0.0
    out[8] = 1.0 if lane["right"] >= 0 else 0.0
    out[9] = step["change"]
    out[10] = unit(max(step["room"] - row["s"], 0.0) / ROOM_SCALE)
    out[11] = unit(max(row["to_go"], 0.0) / TO_GO_SCALE)
    out[12] = unit(row["target_speed"] / SPEED_SCALE)


@kernel
def observe_size(kind: np.void, row: np.void, out: NDArray[np.float32]) -> None:
    """Write size and limits of the vehicle's type, after `observe_ego`."""
    out[EGO_FEATURES] = unit(row["length"] / LENGTH_SCALE)
    out[EGO_FEATURES + 1] = unit(row["width"] / OFFSET_SCALE)
    out[EGO_FEATURES + 2] = unit(kind["wheelbase"] / WHEELBASE_SCALE)
    out[EGO_FEATURES + 3] = unit(kind["most_steering"] / STEERING_SCALE)
    out[EGO_FEATURES + 4] = unit(kind["most_accel"] / ACCEL_SCALE)
    out[EGO_FEATURES + 5] = unit(kind["most_decel"] / ACCEL_SCALE)
    out[EGO_FEATURES + 6] = unit(kind["max_speed"] / SPEED_SCALE)


@kernel
def observe_route(
    roads: RoadArrays,
    plans: NDArray[np.void],
    row: np.void,
    sensors: Sensors,
    out: NDArray[np.float32],
) -> None:
    """Write points of the path ahead in the ego frame; beyond its end, repeat the last point."""
    cos_heading, sin_heading = cos_sin(row["heading"])
    scale = sensors.route_points * sensors.route_spacing_m
    lane = row["lane"]
    s = row["s"]
    for k in range(sensors.route_points):
        s += sensors.route_spacing_m
        while s > roads.lanes[lane]["length_m"]:
            following = plans[row["goal"], lane]["next"]
            if following < 0:
                s = roads.lanes[lane]["length_m"]
                break
            s -= roads.lanes[lane]["length_m"]
            lane = following
        here = roads.lanes[lane]
        x, y, _, _, _, _ = lane_pose(roads.points, here["first_point"], here["num_points"], s)
        dx = x - row["x"]
        dy = y - row["y"]
        at = sensors.route_at + 2 * k
        out[at] = unit((dx * cos_heading + dy * sin_heading) / scale)
        out[at + 1] = unit((dy * cos_heading - dx * sin_heading) / scale)


@kernel
def observe_neighbors(
    rows: NDArray[np.void], i: int, grid: Grid, sensors: Sensors, out: NDArray[np.float32]
) -> None:
    """Write the nearest vehicles in the ego frame, nearest first; 0 for missing vehicles.

    Vehicles hidden by `sensors.walls` are left out.
    """
    if sensors.neighbors == 0:
        return
    row = rows[i]
    found = nearest_bodies(
        grid,
        i,
        row["x"],
        row["y"],
        row["z"],
        sensors.neighbors_range_m,
        sensors.near_body.shape[0],
        sensors.near_body,
        sensors.near_squared,
    )
    cos_heading, sin_heading = cos_sin(row["heading"])
    k = 0
    for candidate in range(found):
        if k == sensors.neighbors:
            break
        other = grid.bodies[sensors.near_body[candidate]]
        if is_cut(sensors.walls, row["x"], row["y"], other["x"], other["y"]):
            continue
        dx = other["x"] - row["x"]
        dy = other["y"] - row["y"]
        cos_other = other["cos"]
        sin_other = other["sin"]
        dvx = other["speed"] * cos_other - row["speed"] * cos_heading
        dvy = other["speed"] * sin_other - row["speed"] * sin_heading
        at = sensors.neighbors_at + NEIGHBOR_FEATURES * k
        out[at] = 1.0
        out[at + 1] = (dx * cos_heading + dy * sin_heading) / sensors.neighbors_range_m
        out[at + 2] = (dy * cos_heading - dx * sin_heading) / sensors.neighbors_range_m
        out[at + 3] = unit((dvx * cos_heading + dvy * sin_heading) / SPEED_SCALE)
        out[at + 4] = unit((dvy * cos_heading - dvx * sin_heading) / SPEED_SCALE)
        out[at + 5] = unit(cos_other * cos_heading + sin_other * sin_heading)
        out[at + 6] = unit(sin_other * cos_heading - cos_other * sin_heading)
        k += 1


@kernel
def gives_way_on(roads: RoadArrays, link: int, signal: int) -> bool:
    """Return whether a driver on this link must yield to another link now."""
    if signal == SIGNAL_GREEN_MAJOR or signal == SIGNAL_OFF:
        return False
    first = roads.links[link]["first_conflict"]
    for c in range(first, first + roads.links[link]["num_conflicts"]):
        if roads.conflicts[c]["must_yield"]:
            return True
    return False


@kernel
def observe_signal(
    roads: RoadArrays,
    plans: NDArray[np.void],
    controllers: NDArray[np.void],
    row: np.void,
    phase: NDArray[np.int32],
    time: float,
    tick_s: float,
    sensors: Sensors,
    out: NDArray[np.float32],
) -> None:
    """Write the next stop line on the path with a signal or a duty to yield.

    With `signal_stop_signs`, this includes stop signs without foes, and the last feature marks stop
    signs. `time`: time of the tick, in s since the world's reset.
    """
    at = sensors.signal_at
    stops = False
    lane = row["lane"]
    distance = -row["s"]
    while True:
        distance += roads.lanes[lane]["length_m"]
        step = plans[row["goal"], lane]
        if distance > sensors.signal_range_m or step["next"] < 0:
            return
        if step["link"] >= 0:
            signal = link_signal(roads, step["link"], phase)
            gives_way = gives_way_on(roads, step["link"], signal)
            stops = sensors.signal_stop_signs and must_stop(roads, step["link"], signal)
            if signal != SIGNAL_NONE or gives_way or stops:
                break
        lane = step["next"]
    out[at] = 1.0
    out[at + 1] = distance / sensors.signal_range_m
    if signal == SIGNAL_RED or signal == SIGNAL_RED_YELLOW or signal == SIGNAL_STOP_THEN_GO:
        out[at + 2] = 1.0
    elif signal == SIGNAL_YELLOW_MINOR or signal == SIGNAL_YELLOW_MAJOR:
        out[at + 3] = 1.0
    elif signal == SIGNAL_GREEN_MAJOR or signal == SIGNAL_GREEN_MINOR:
        out[at + 4] = 1.0
    out[at + 5] = 1.0 if gives_way or (stops and signal == SIGNAL_NONE) else 0.0
    if sensors.signal_stop_signs:
        out[at + SIGNAL_FEATURES + (2 if sensors.signal_timing else 0)] = 1.0 if stops else 0.0
    if sensors.signal_timing and signal != SIGNAL_NONE:
        change = time_to_change(roads, controllers, step["link"], phase, time, tick_s)
        out[at + 6] = soonness(change)
        out[at + 7] = soonness(max(distance, 0.0) / max(row["speed"], SLOWEST_MPS))


@kernel
def observe_lidar(
    rows: NDArray[np.void], i: int, grid: Grid, sensors: Sensors, out: NDArray[np.float32]
) -> None:
    """Write the distances along the rays (1 without a hit), then the relative speeds, if any."""
    rays = sensors.lidar_rays
    if rays == 0:
        return
    lidar(rows, i, grid, sensors.rays, sensors.lidar_range_m, sensors.echoes)
    at = sensors.lidar_at
    for k in range(rays):
        echo = sensors.echoes[k]
        # Most rays hit nothing; avoid the division for them.
        if echo["id"] < 0:
            out[at + k] = 1.0
            continue
        out[at + k] = echo["distance"] / sensors.lidar_range_m
        if sensors.lidar_speeds:
            out[at + rays + k] = unit(echo["speed"] / SPEED_SCALE)


@kernel
def observe_frame(
    roads: RoadArrays,  # roads of the world
    plans: NDArray[np.void],  # PLAN (G, L) that the vehicle follows
    travel: TripTables,
    rows: NDArray[np.void],
    i: int,
    grid: Grid,
    controllers: NDArray[np.void],
    phase: NDArray[np.int32],
    tick: int,
    tick_s: float,
    sensors: Sensors,
    out: NDArray[np.float32],
) -> None:
    """Write the features of row i to a frame; those of optional sensors are left out."""
    row = rows[i]
    if sensors.ego:
        observe_ego(roads, plans, row, out)
        if sensors.ego_size:
            observe_size(travel.types[row["vtype"]], row, out)
    observe_route(roads, plans, row, sensors, out)
    observe_neighbors(rows, i, grid, sensors, out)
    if sensors.signal:
        time = tick * tick_s
        observe_signal(roads, plans, controllers, row, phase, time, tick_s, sensors, out)
    observe_lanes(roads, travel, rows, i, grid, phase, sensors, out)
    observe_lidar(rows, i, grid, sensors, out)


@kernel
def sense(
    roads: RoadArrays,
    plans: NDArray[np.void],
    travel: TripTables,
    worlds: Worlds,
    grid: Grid,
    sensors: Sensors,
    tick_s: float,
    ticks_per_step: int,
    chosen: NDArray[np.bool_],
    outputs: Outputs,
) -> None:
    """Write observations and reward terms of all owned agents of the chosen worlds, by agent index.

    A vehicle that entered during the step has not acted: it is observed, its terms are 0, and its
    trip does not end. `observe_optional` and `fill_stacks` complete the observations.
    `rewards.kernels.reward` sums the terms after all shards have written their terms.

    `worlds`: committed rows at the end of the step, including ghosts. `outputs`: cleared in the
    chosen worlds; written at the indices of owned agents.
    """
    step_s = tick_s * ticks_per_step
    for w in range(worlds.ticks.shape[0]):
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
                is_filled = True
            own_plans = plans[plans_of(plans, row, w)]
            agent = row["agent"]
            seen = outputs.observations[w, agent]
            shift_frames(seen, sensors.stack, sensors.history_at, sensors.history)
            out = seen[newest_frame(seen, sensors.stack) :]
            observe_frame(
                here,
                own_plans,
                travel,
                rows,
                i,
                grid,
                worlds.controllers[w],
                worlds.signal_phase[w],
                worlds.ticks[w],
                tick_s,
                sensors,
                out,
            )
            outputs.present[w, agent] = True
            outputs.vehicle_ids[w, agent] = row["id"]
            outputs.places[w, agent, 0] = row["x"]
            outputs.places[w, agent, 1] = row["y"]
            if has_entered(row, ticks_per_step):
                continue
            write_terms(
                here,
                rows,
                i,
                travel.types[row["vtype"]],
                grid,
                step_s,
                outputs.terms[w, agent],
            )
            outputs.acted[w, agent] = True
            outputs.terminated[w, agent] = row["events"] & EVENTS_THAT_END != 0
            outputs.events[w, agent] = row["events"]
