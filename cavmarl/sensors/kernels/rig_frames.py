"""What all mounted sensors have in common: carriers, rates, stamps, counts, and lost samples.

When samples are taken is a pure function of a world's tick: sample k is due k · ticks / samples
ticks after the phase, and delivered by the first tick at or after that. So nothing has to be kept,
and no migration, reset or repeated tick can move it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba import kernel
from cavmarl.core.records import record
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.sensors.kernels.rig_noise import is_lost


class SensorSchedule(NamedTuple):
    """The rate of a sensor: `samples` in `ticks` ticks, in lowest terms."""

    samples: int
    ticks: int
    phase: int  # tick of sample 0
    ticks_per_step: int
    slots: int  # the most samples in a step


class Due(NamedTuple):
    """What one sensor has to deliver in the present tick of each world."""

    num: NDArray[np.int64]  # (W,) samples
    first: NDArray[np.int64]  # (W,) number of the first one, since the reset
    slot: NDArray[np.int64]  # (W,) where it is written; the last of a step lies in the last slot


@kernel
def taken(schedule: SensorSchedule, tick: int) -> int:
    """How many samples are taken at or before a tick."""
    since = tick - schedule.phase
    if since < 0:
        return 0
    return since * schedule.samples // schedule.ticks + 1


@kernel
def stamp_of(schedule: SensorSchedule, number: int, tick: int, tick_s: float) -> float:
    """The time of a sample in s since the reset, delivered by `tick`.

    Of a sensor with several samples a tick it may lie between two; all others sense the state of
    the tick, and that is what the stamp says.
    """
    if schedule.samples <= schedule.ticks:
        return tick * tick_s
    return (schedule.phase + number * schedule.ticks / schedule.samples) * tick_s


@kernel
def call_due(
    schedule: SensorSchedule, ticks: NDArray[np.int64], chosen: NDArray[np.bool_], due: Due
) -> bool:
    """Write what is due in the chosen worlds, and nothing for the others.

    `ticks`: (W,) since each world's reset.

    Returns whether anything is.
    """
    found = False
    for w in range(ticks.size):
        due.num[w] = 0
        if not chosen[w]:
            continue
        tick = ticks[w]
        before = taken(schedule, tick - 1)
        count = taken(schedule, tick) - before
        if count > 0:
            step_end = -(-tick // schedule.ticks_per_step) * schedule.ticks_per_step
            due.num[w] = count
            due.first[w] = before
            due.slot[w] = schedule.slots - (taken(schedule, step_end) - before)
            found = True
    return found


POSE = record(
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
