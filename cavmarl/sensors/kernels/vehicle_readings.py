"""Readings of the vehicle that carries the sensor: inertia, position, wheels, lane, and events."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cos_sin, tangent
from cavmarl.core.math.geometry import lane_pose, project_near, wrap_angle
from cavmarl.core.records.arrays import RoadArrays, Worlds
from cavmarl.core.records.codes import EVENT_COLLIDED
from cavmarl.roads.kernels.lanes_now import plans_of
from cavmarl.sensors.kernels.rig_frames import (
    Due,
    Mount,
    Noise,
    add_errors,
    carries,
    is_lost,
    sensor_pose,
)

GRAVITY_MPS2 = 9.80665  # standard gravity


@kernel
def measure_motion(
    row: np.void, pose: np.void, share: float, tick_s: float, mount: Mount, out: NDArray[np.float64]
) -> None:
    """Write specific force and angular rate at a place on a vehicle, within its last tick.

    The vehicle's centre moves with `speed` at the slip angle of the kinematic bicycle, whose
    tangent is half that of the steering angle. In the vehicle's frame, with the yaw rate r:

        force = (a cos slip - v r sin slip, a sin slip + v r cos slip, 0)  of the centre
              + (-r' y - r² x, r' x - r² y, 0)                        of a place off the centre
              + g (sin pitch, 0, cos pitch)                           reaction to gravity
        rate  = (r sin pitch, -pitch', r cos pitch)

    Speed, acceleration, yaw rate, steering and pitch are interpolated linearly between the states
    before and after the tick; r' and pitch' are the slopes. The rate of the slip angle is
    neglected: the bicycle model changes the steering at once at the start of a tick, so the
    rate would give force peaks.

    `row`: VEHICLE after the tick. `pose`: POSE before the tick; if it belongs to another vehicle,
    the state of `row` is used. `share`: elapsed share of the tick, in (0, 1]. `out`: (6,) m/s² and
    rad/s, along the sensor's axes.
    """
    left = 1.0 - share if pose["id"] == row["id"] else 0.0
    speed = row["speed"] + left * (pose["speed"] - row["speed"])
    accel = row["accel"] + left * (pose["accel"] - row["accel"])
    yaw_rate = row["yaw_rate"] + left * (pose["yaw_rate"] - row["yaw_rate"])
    steering = row["steering"] + left * (pose["steering"] - row["steering"])
    pitch = row["pitch"] + left * (pose["pitch"] - row["pitch"])
    yaw_accel = 0.0
    pitch_rate = 0.0
    if pose["id"] == row["id"]:
        yaw_accel = (row["yaw_rate"] - pose["yaw_rate"]) / tick_s
        pitch_rate = wrap_angle(row["pitch"] - pose["pitch"]) / tick_s
    tan_slip = 0.5 * tangent(steering)
    cos_slip = 1.0 / math.sqrt(1.0 + tan_slip * tan_slip)
    sin_slip = tan_slip * cos_slip
    cos_pitch, sin_pitch = cos_sin(pitch)
    x, y = mount.place[0], mount.place[1]
    inwards = speed * yaw_rate
    force_x = accel * cos_slip - inwards * sin_slip - yaw_accel * y - yaw_rate * yaw_rate * x
    force_y = accel * sin_slip + inwards * cos_slip + yaw_accel * x - yaw_rate * yaw_rate * y
    force_x += GRAVITY_MPS2 * sin_pitch
    force_z = GRAVITY_MPS2 * cos_pitch
    rate_x, rate_y, rate_z = yaw_rate * sin_pitch, -pitch_rate, yaw_rate * cos_pitch
    turn = mount.turn
    for axis in range(3):
        out[axis] = turn[0, axis] * force_x + turn[1, axis] * force_y + turn[2, axis] * force_z
        out[3 + axis] = turn[0, axis] * rate_x + turn[1, axis] * rate_y + turn[2, axis] * rate_z


@kernel
def measure_inertia(
    worlds: Worlds,
    before: NDArray[np.void],
    mount: Mount,
    tick_s: float,
    due: Due,
    noise: Noise,
    scratch: NDArray[np.float64],
    data: NDArray[np.float32],
) -> None:
    """Write the samples that are due for the owned agents.

    `before`: POSE (W, A) at the previous tick. `scratch`: (6,). `data`: (W, A, S, 6) force, rate.
    """
    for w in range(worlds.ticks.size):
        num = due.num[w]
        if num == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if not carries(due, row):
                continue
            agent = row["agent"]
            for k in range(num):
                measure_motion(row, before[w, agent], (k + 1) / num, tick_s, mount, scratch)
                add_errors(noise, row, worlds.ticks[w], k, scratch)
                for channel in range(scratch.size):
                    data[w, agent, due.slot[w] + k, channel] = scratch[channel]


@kernel
def measure_places(
    worlds: Worlds,
    mount: Mount,
    due: Due,
    noise: Noise,
    scratch: NDArray[np.float64],
    places: NDArray[np.float64],
    measured: NDArray[np.bool_],
) -> None:
    """Write the due antenna positions of the owned agents.

    `due`: at most one sample in this tick. `noise`: the sensor's errors, along the axes of the map.
    `scratch`: (2, 3, 3), overwritten. `places`: (W, A, 3) x, y, z in m. `measured`: (W, A) set for
    agents whose position is written.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if not carries(due, row):
                continue
            place = places[w, row["agent"]]
            place[0], place[1], place[2] = sensor_pose(row, mount, scratch[0], scratch[1])
            add_errors(noise, row, worlds.ticks[w], 0, place)
            measured[w, row["agent"]] = True


@kernel
def measure_odometry(
    worlds: Worlds,
    before: NDArray[np.void],
    due: Due,
    noise: Noise,
    scratch: NDArray[np.float64],
    data: NDArray[np.float32],
) -> None:
    """Write the samples that are due for the owned agents.

    Of n samples in a tick, the k-th is interpolated at k / n between the states before and after
    the tick. A vehicle that entered in this tick has the same state before and after.

    `before`: POSE (W, A) at the previous tick. `scratch`: (3,). `data`: (W, A, S, 3) speed in m/s,
    yaw rate in rad/s, distance in m since departure.
    """
    for w in range(worlds.ticks.size):
        count = due.num[w]
        if count == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if not carries(due, row):
                continue
            agent = row["agent"]
            pose = before[w, agent]
            was_there = pose["id"] == row["id"]
            for k in range(count):
                left = 1.0 - (k + 1) / count if was_there else 0.0
                scratch[0] = row["speed"] + left * (pose["speed"] - row["speed"])
                scratch[1] = row["yaw_rate"] + left * (pose["yaw_rate"] - row["yaw_rate"])
                scratch[2] = row["distance_m"] + left * (pose["distance_m"] - row["distance_m"])
                add_errors(noise, row, worlds.ticks[w], k, scratch)
                for channel in range(3):
                    data[w, agent, due.slot[w] + k, channel] = scratch[channel]


_WINDOW_M = 15.0  # the sensor's lane position is searched this far around the vehicle's position


@kernel
def _way_ahead(
    roads: RoadArrays, plans: NDArray[np.void], row: np.void, ahead: float
) -> tuple[float, float]:
    """Return x and y of a point on a vehicle's path, or of the end of the path."""
    lane = row["lane"]
    s = row["s"] + ahead
    while s > roads.lanes[lane]["length_m"]:
        following = plans[row["goal"], lane]["next"]
        if following < 0:
            s = roads.lanes[lane]["length_m"]
            break
        s -= roads.lanes[lane]["length_m"]
        lane = following
    here = roads.lanes[lane]
    x, y, _, _, _, _ = lane_pose(roads.points, here["first_point"], here["num_points"], s)
    return x, y


@kernel
def bend(x0: float, y0: float, x1: float, y1: float, x2: float, y2: float) -> float:
    """Return the curvature of the circle through three points in 1/m, positive to the left.

    The curvature is four times the triangle's area divided by the product of its sides; 0 if two
    points coincide.
    """
    ax, ay = x1 - x0, y1 - y0
    bx, by = x2 - x1, y2 - y1
    cx, cy = x2 - x0, y2 - y0
    sides = math.sqrt((ax * ax + ay * ay) * (bx * bx + by * by) * (cx * cx + cy * cy))
    return 2.0 * (ax * by - ay * bx) / sides if sides > 0.0 else 0.0


@kernel
def measure_lane_boundary(
    roads: RoadArrays,
    plans: NDArray[np.void],
    worlds: Worlds,
    mount: Mount,
    lookahead_m: float,
    due: Due,
    noise: Noise,
    axes: NDArray[np.float64],
    scratch: NDArray[np.float64],
    data: NDArray[np.float32],
) -> None:
    """Write the samples that are due for the owned agents.

    `lookahead_m`: length of the path over which the curvature is measured. `axes`: (2, 3, 3),
    scratch. `scratch`: (5,). `data`: (W, A, S, 5) distances to the left and right boundary and
    width of the lane in m; direction of the sensor relative to the lane in rad; curvature in 1/m.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if not carries(due, row):
                continue
            x, y, _ = sensor_pose(row, mount, axes[0], axes[1])
            lane = roads.lanes[row["lane"]]
            _, offset, cos, sin = project_near(
                roads.points, lane["first_point"], lane["num_points"], x, y, row["s"], _WINDOW_M
            )
            looks = atan2(axes[1, 1, 0], axes[1, 0, 0])
            own_plans = plans[plans_of(plans, row, w)]
            x0, y0 = _way_ahead(roads, own_plans, row, 0.0)
            x1, y1 = _way_ahead(roads, own_plans, row, 0.5 * lookahead_m)
            x2, y2 = _way_ahead(roads, own_plans, row, lookahead_m)
            scratch[0] = 0.5 * lane["width_m"] - offset
            scratch[1] = 0.5 * lane["width_m"] + offset
            scratch[2] = lane["width_m"]
            scratch[3] = wrap_angle(looks - atan2(sin, cos))
            scratch[4] = bend(x0, y0, x1, y1, x2, y2)
            add_errors(noise, row, worlds.ticks[w], 0, scratch)
            for channel in range(scratch.size):
                data[w, row["agent"], due.slot[w], channel] = scratch[channel]


@kernel
def report_events(
    worlds: Worlds,
    before: NDArray[np.void],
    ticks_per_step: int,
    tick_s: float,
    due: Due,
    stream: np.uint64,
    dropout: float,
    stamp_s: NDArray[np.float64],
    lost: NDArray[np.bool_],
    fresh: NDArray[np.int64],
    data: NDArray[np.int64],
) -> None:
    """Write a report for each owned agent with an event in this tick.

    Earlier reports move towards the first slot; the newest report is the last.

    Args:
        worlds: committed rows.
        before: POSE (W, A) at the previous tick.
        ticks_per_step: ticks per step; VEHICLE["events"] is cleared at each step.
        tick_s: seconds per tick.
        due: the worlds in which reports are due.
        stream: stream of the sensor's random numbers.
        dropout: probability that a report is lost.
        stamp_s: (W, A, S) in s since the reset.
        lost: (W, A, S) whether each report is lost.
        fresh: (W, A) number of reports in this step so far.
        data: (W, A, S, 2) EVENT_* bits, and the id of the vehicle that was hit, or -1.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        tick = worlds.ticks[w]
        begins_step = (tick - 1) % ticks_per_step == 0
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if not carries(due, row):
                continue
            agent = row["agent"]
            pose = before[w, agent]
            known = 0 if begins_step or pose["id"] != row["id"] else pose["events"]
            events = row["events"] & ~known
            if events == 0:
                continue
            last = stamp_s.shape[2] - 1
            for slot in range(last):
                stamp_s[w, agent, slot] = stamp_s[w, agent, slot + 1]
                lost[w, agent, slot] = lost[w, agent, slot + 1]
                data[w, agent, slot, 0] = data[w, agent, slot + 1, 0]
                data[w, agent, slot, 1] = data[w, agent, slot + 1, 1]
            is_gone = is_lost(row, stream, tick, 0, dropout)
            stamp_s[w, agent, last] = tick * tick_s
            lost[w, agent, last] = is_gone
            data[w, agent, last, 0] = 0 if is_gone else events
            hit = row["hit"] if events & EVENT_COLLIDED else -1
            data[w, agent, last, 1] = 0 if is_gone else hit
            fresh[w, agent] += 1
