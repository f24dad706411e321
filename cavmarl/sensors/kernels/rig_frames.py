"""What all mounted sensors have in common: carriers, stamps, counts, and lost samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.sensors.kernels.rig_noise import is_lost
from cavmarl.sensors.kernels.rig_schedule import Due, SensorSchedule, stamp_of

POSE = np.dtype(
    [
        ("id", np.int64),  # of the vehicle; -1: none
        ("x", np.float64),  # as in VEHICLE
        ("y", np.float64),
        ("z", np.float64),
        ("heading", np.float64),
        ("pitch", np.float64),
        ("speed", np.float64),
        ("accel", np.float64),
        ("yaw_rate", np.float64),
        ("steering", np.float64),
        ("distance_m", np.float64),
        ("events", np.int32),
    ],
    align=True,
)


@kernel
def call_roll(worlds: Worlds, ids: NDArray[np.int64]) -> None:
    """Write the vehicle of each owned agent to `ids` (W, A)."""
    for w in range(worlds.ticks.size):
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] == DRIVER_AGENT:
                ids[w, row["agent"]] = row["id"]


@kernel
def note_poses(worlds: Worlds, poses: NDArray[np.void]) -> None:
    """Write where each owned agent is, and how it moves, to `poses`, POSE (W, A)."""
    for w in range(worlds.ticks.size):
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] != DRIVER_AGENT:
                continue
            pose = poses[w, row["agent"]]
            pose["id"] = row["id"]
            pose["x"] = row["x"]
            pose["y"] = row["y"]
            pose["z"] = row["z"]
            pose["heading"] = row["heading"]
            pose["pitch"] = row["pitch"]
            pose["speed"] = row["speed"]
            pose["accel"] = row["accel"]
            pose["yaw_rate"] = row["yaw_rate"]
            pose["steering"] = row["steering"]
            pose["distance_m"] = row["distance_m"]
            pose["events"] = row["events"]


@kernel
def deliver(
    worlds: Worlds,
    schedule: SensorSchedule,
    due: Due,
    tick_s: float,
    stream: np.uint64,
    dropout: float,
    stamp_s: NDArray[np.float64],
    lost: NDArray[np.bool_],
    fresh: NDArray[np.int64],
    data: NDArray[np.uint8],
) -> None:
    """Stamp and count the samples that owned agents have got in this tick; lose some of them.

    `stream`: of the sensor's random numbers. `dropout`: chance that a sample is lost. `stamp_s`:
    (W, A, S) in s since the reset. `lost`: (W, A, S) which ones are lost. `fresh`: (W, A) samples
    of this step, up to now. `data`: (W, A, S, bytes); of lost samples all zeros.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        tick = worlds.ticks[w]
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] != DRIVER_AGENT:
                continue
            agent = row["agent"]
            fresh[w, agent] += due.num[w]
            for k in range(due.num[w]):
                slot = due.slot[w] + k
                stamp_s[w, agent, slot] = stamp_of(schedule, due.first[w] + k, tick, tick_s)
                lost[w, agent, slot] = is_lost(row, stream, tick, k, dropout)
                if lost[w, agent, slot]:
                    data[w, agent, slot, :] = 0
