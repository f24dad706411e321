"""What an inertial measurement unit on an agent's vehicle feels: specific force, and turning."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import wrap_angle
from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.sensors.kernels.mount_poses import Mount
from cavmarl.sensors.kernels.rig_noise import Noise, add_errors
from cavmarl.sensors.kernels.rig_schedule import Due

GRAVITY_MPS2 = 9.80665  # standard gravity


@kernel
def feel(
    row: np.void, pose: np.void, share: float, tick_s: float, mount: Mount, out: NDArray[np.float64]
) -> None:
    """Specific force and angular rate at a place on a vehicle, within its last tick.

    The vehicle's centre moves with `speed` at the slip angle of the kinematic bicycle, whose
    tangent is half that of the steering angle. In the vehicle's frame, with the yaw rate r:

        force = (a cos slip - v r sin slip, a sin slip + v r cos slip, 0)  of the centre
              + (-r' y - r² x, r' x - r² y, 0)                        of a place beside it
              + g (sin pitch, 0, cos pitch)                           what holds it up
        rate  = (r sin pitch, -pitch', r cos pitch)

    Speed, acceleration, yaw rate, steering and pitch lie on the straight line from the state before
    the tick to that after it; r' and pitch' are its slopes. What a change of the slip angle adds is
    left out: the steering of the bicycle jumps.

    `row`: VEHICLE, after the tick. `pose`: POSE before it; of another vehicle: it was as it is now.
    `share`: of the tick that has passed, in (0, 1]. `out`: (6,) m/s² and rad/s, along the sensor's
    axes.
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
    tan_slip = 0.5 * math.tan(steering)
    cos_slip = 1.0 / math.sqrt(1.0 + tan_slip * tan_slip)
    sin_slip = tan_slip * cos_slip
    cos_pitch, sin_pitch = math.cos(pitch), math.sin(pitch)
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
    room: NDArray[np.float64],
    data: NDArray[np.float32],
) -> None:
    """Write what is due of the owned agents.

    `before`: POSE (W, A) of the tick before. `room`: (6,). `data`: (W, A, S, 6) as `feel` gives it.
    """
    for w in range(worlds.ticks.size):
        num = due.num[w]
        if num == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] != DRIVER_AGENT:
                continue
            agent = row["agent"]
            for k in range(num):
                feel(row, before[w, agent], (k + 1) / num, tick_s, mount, room)
                add_errors(noise, row, worlds.ticks[w], k, room)
                for channel in range(room.size):
                    data[w, agent, due.slot[w] + k, channel] = room[channel]
