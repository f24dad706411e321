"""What the wheels of agents' vehicles tell: speed, yaw rate and distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.sensors.kernels.rig_noise import Noise, add_errors
from cavmarl.sensors.kernels.rig_schedule import Due


@kernel
def measure_odometry(
    worlds: Worlds,
    before: NDArray[np.void],
    due: Due,
    noise: Noise,
    room: NDArray[np.float64],
    data: NDArray[np.float32],
) -> None:
    """Write what is due of the owned agents.

    Of n samples in a tick, the k-th lies a share of k / n on the straight line from the state
    before the tick to that after it; one that entered in this tick was before as it is now.

    `before`: POSE (W, A) of the tick before. `room`: (3,). `data`: (W, A, S, 3) speed in m/s, yaw
    rate in rad/s, distance in m since departure.
    """
    for w in range(worlds.ticks.size):
        count = due.num[w]
        if count == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] != DRIVER_AGENT:
                continue
            agent = row["agent"]
            pose = before[w, agent]
            was_there = pose["id"] == row["id"]
            for k in range(count):
                left = 1.0 - (k + 1) / count if was_there else 0.0
                room[0] = row["speed"] + left * (pose["speed"] - row["speed"])
                room[1] = row["yaw_rate"] + left * (pose["yaw_rate"] - row["yaw_rate"])
                room[2] = row["distance_m"] + left * (pose["distance_m"] - row["distance_m"])
                add_errors(noise, row, worlds.ticks[w], k, room)
                for channel in range(3):
                    data[w, agent, due.slot[w] + k, channel] = room[channel]
