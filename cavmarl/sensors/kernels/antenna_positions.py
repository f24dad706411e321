"""Where the antennas of agents' vehicles are, in the map's frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.sensors.kernels.mount_poses import Mount, sensor_pose
from cavmarl.sensors.kernels.rig_noise import Noise, add_errors
from cavmarl.sensors.kernels.rig_schedule import Due


@kernel
def measure_places(
    worlds: Worlds,
    mount: Mount,
    due: Due,
    noise: Noise,
    room: NDArray[np.float64],
    places: NDArray[np.float64],
    measured: NDArray[np.bool_],
) -> None:
    """Write where the antennas are of the owned agents that are due.

    `due`: in this tick, one sample at most. `noise`: of the sensor, along the axes of the map.
    `room`: (2, 3, 3), overwritten. `places`: (W, A, 3) x, y, z in m. `measured`: (W, A) set for
    those that are written.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] != DRIVER_AGENT:
                continue
            place = places[w, row["agent"]]
            place[0], place[1], place[2] = sensor_pose(row, mount, room[0], room[1])
            add_errors(noise, row, worlds.ticks[w], 0, place)
            measured[w, row["agent"]] = True
