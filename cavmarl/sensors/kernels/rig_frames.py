"""Common parts of mounted sensors: poses, errors, sampling times, counts, and lost samples.

The sampling schedule is a pure function of a world's tick: sample k is due k · ticks / samples
ticks after tick `phase`, and the first tick at or after that time delivers it. So the schedule has
no state that a migration, reset or repeated tick could change.

Frames are right-handed: x forward, y left, z up. An orientation is given by yaw (counter-clockwise
seen from above), then pitch (positive upwards), then roll (positive with the left side up), each
about the axes that result from the previous rotations. The vehicle's origin lies on the ground
below the centre of the body.

Errors depend only on vehicle, tick, sensor and draw. The key of a sensor's random numbers is mixed
from the key of the vehicle and the stream of the sensor. So no two sensors share random numbers,
and adding a sensor does not change the random numbers of another.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import cos_sin, cosine, log
from cavmarl.core.math.geometry import TWO_PI
from cavmarl.core.math.rng import mix, quick_uniform
from cavmarl.core.records import record
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import DRIVER_AGENT

# Numbers of the draws for biases and dropouts, which differ from the draws for samples.
_BIAS = 1 << 28
_DROPOUT = 1 << 29


class Noise(NamedTuple):
    """The error model of a sensor."""

    stream: np.uint64
    noise: NDArray[np.float64]  # (channels,) standard deviation of each sample
    bias: NDArray[np.float64]  # (channels,) standard deviation of the constant error of an episode


@kernel
def sensor_key(row: np.void, stream: np.uint64) -> np.uint64:
    """Return the key of a sensor's random numbers on a vehicle."""
    return mix(row["rng_key"] ^ stream)


@kernel
def gauss(key: np.uint64, vehicle: int, tick: int, draw: int) -> float:
    """Draw a number from the standard normal distribution.

    Source: Box and Muller, "A note on the generation of random normal deviates", 1958.

    `draw`: number of the draw in this tick, below 2**30.
    """
    radius = math.sqrt(-2.0 * log(1.0 - quick_uniform(key, vehicle, tick, 2 * draw)))
    return radius * cosine(TWO_PI * quick_uniform(key, vehicle, tick, 2 * draw + 1))


@kernel
def error_of(
    noise: Noise, key: np.uint64, vehicle: int, tick: int, draw: int, channel: int
) -> float:
    """Return the error of one measured number.

    `draw`: index of the number in this tick, below 2**28. `channel`: the channel to which the
    number belongs.
    """
    error = 0.0
    if noise.noise[channel] > 0.0:
        error = noise.noise[channel] * gauss(key, vehicle, tick, draw)
    if noise.bias[channel] > 0.0:
        error += noise.bias[channel] * gauss(key, vehicle, 0, _BIAS + channel)
    return error


@kernel
def add_errors(
    noise: Noise, row: np.void, tick: int, sample: int, out: NDArray[np.float64]
) -> None:
    """Add an error to each channel of a sample (channels,).

    `row`: VEHICLE that carries the sensor. `sample`: index of the sample in the tick. `out`: the
    sample, updated.
    """
    key = sensor_key(row, noise.stream)
    for channel in range(out.size):
        draw = sample * out.size + channel
        out[channel] += error_of(noise, key, row["id"], tick, draw, channel)


@kernel
def is_lost(row: np.void, stream: np.uint64, tick: int, sample: int, dropout: float) -> bool:
    """Return whether a sample of a tick is lost, with probability `dropout`."""
    if dropout <= 0.0:
        return False
    key = sensor_key(row, stream)
    return quick_uniform(key, row["id"], tick, _DROPOUT + sample) < dropout


class Mount(NamedTuple):
    """A position and an orientation in the vehicle's frame."""

    place: NDArray[np.float64]  # (3,) m
    turn: NDArray[np.float64]  # (3, 3) rotates a vector of the sensor's frame into the vehicle's


@kernel
def rotation(yaw: float, pitch: float, roll: float, out: NDArray[np.float64]) -> None:
    """Write the matrix that rotates a vector of the rotated frame into the outer frame.

    `pitch`: rad, positive upwards. `roll`: rad, positive with the left side up. `out`: (3, 3),
    overwritten; its columns are the axes of the rotated frame.
    """
    cos_yaw, sin_yaw = cos_sin(yaw)
    cos_pitch, sin_pitch = cos_sin(pitch)
    cos_roll, sin_roll = cos_sin(roll)
    out[0, 0] = cos_yaw * cos_pitch
    out[1, 0] = sin_yaw * cos_pitch
    out[2, 0] = sin_pitch
    out[0, 1] = -cos_yaw * sin_pitch * sin_roll - sin_yaw * cos_roll
    out[1, 1] = -sin_yaw * sin_pitch * sin_roll + cos_yaw * cos_roll
    out[2, 1] = cos_pitch * sin_roll
    out[0, 2] = -cos_yaw * sin_pitch * cos_roll + sin_yaw * sin_roll
    out[1, 2] = -sin_yaw * sin_pitch * cos_roll - cos_yaw * sin_roll
    out[2, 2] = cos_pitch * cos_roll


@kernel
def turned(matrix: NDArray[np.float64], x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a vector rotated by a matrix (3, 3)."""
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


@kernel
def sensor_pose(
    row: np.void, mount: Mount, body: NDArray[np.float64], axes: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Compute the position and orientation of a sensor in the world.

    Args:
        row: VEHICLE that carries the sensor.
        mount: pose of the sensor on the vehicle.
        body: (3, 3), overwritten: rotation from the vehicle's frame to the world's.
        axes: (3, 3), overwritten: rotation from the sensor's frame to the world's.

    Returns:
        x, y, z in m.
    """
    rotation(row["heading"], row["pitch"], 0.0, body)
    for column in range(3):
        axes[0, column], axes[1, column], axes[2, column] = turned(
            body, mount.turn[0, column], mount.turn[1, column], mount.turn[2, column]
        )
    x, y, z = turned(body, mount.place[0], mount.place[1], mount.place[2])
    return row["x"] + x, row["y"] + y, row["z"] + z


class SensorSchedule(NamedTuple):
    """The rate of a sensor: `samples` per `ticks`, in lowest terms."""

    samples: int
    ticks: int
    phase: int  # tick of sample 0
    ticks_per_step: int
    slots: int  # largest number of samples in a step


NUM_COUNTS = 3  # fields of `Due` that change from tick to tick


class Due(NamedTuple):
    """The samples that a sensor must deliver in the current tick of each world."""

    num: NDArray[np.int64]  # (W,) number of samples
    first: NDArray[np.int64]  # (W,) index of the first sample since the reset
    slot: NDArray[np.int64]  # (W,) slot of the first sample; a step's last sample has the last slot
    carriers: NDArray[np.bool_]  # (A,) agents whose vehicles carry the sensor


@kernel
def carries(due: Due, row: np.void) -> bool:
    """Return whether a vehicle belongs to an agent and carries the sensor."""
    carried: bool = row["driver"] == DRIVER_AGENT and due.carriers[row["agent"]]
    return carried


@kernel
def taken(schedule: SensorSchedule, tick: int) -> int:
    """Return the number of samples since the reset that are taken at or before a tick."""
    since = tick - schedule.phase
    if since < 0:
        return 0
    return since * schedule.samples // schedule.ticks + 1


@kernel
def stamp_of(schedule: SensorSchedule, number: int, tick: int, tick_s: float) -> float:
    """Return the time of a sample that is delivered by `tick`, in s since the reset.

    With several samples per tick, this time may lie between two ticks. Otherwise it is the time of
    the tick whose state the sensor measures.
    """
    if schedule.samples <= schedule.ticks:
        return tick * tick_s
    return (schedule.phase + number * schedule.ticks / schedule.samples) * tick_s


@kernel
def call_due(
    schedule: SensorSchedule, ticks: NDArray[np.int64], chosen: NDArray[np.bool_], due: Due
) -> bool:
    """Determine the samples that are due in the chosen worlds; no samples are due in the others.

    `ticks`: (W,) since each world's reset.

    Returns whether any sample is due.
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
    ("id", np.int64),  # id of the vehicle; -1: none
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
    """Write the vehicle id of each owned agent to `ids` (W, A)."""
    for w in range(worlds.ticks.size):
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if row["driver"] == DRIVER_AGENT:
                ids[w, row["agent"]] = row["id"]


@kernel
def note_poses(worlds: Worlds, poses: NDArray[np.void]) -> None:
    """Write pose and motion of each owned agent to `poses`, POSE (W, A)."""
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
    """Stamp and count the samples of owned agents in this tick, and drop some samples.

    `stream`: stream of the sensor's random numbers. `dropout`: probability that a sample is lost.
    `stamp_s`: (W, A, S) in s since the reset. `lost`: (W, A, S) whether each sample is lost.
    `fresh`: (W, A) number of samples in this step so far. `data`: (W, A, S, bytes); lost samples
    are zeros.
    """
    for w in range(worlds.ticks.size):
        if due.num[w] == 0:
            continue
        tick = worlds.ticks[w]
        for i in range(worlds.num_owned[w]):
            row = worlds.rows[w, i]
            if not carries(due, row):
                continue
            agent = row["agent"]
            fresh[w, agent] += due.num[w]
            for k in range(due.num[w]):
                slot = due.slot[w] + k
                stamp_s[w, agent, slot] = stamp_of(schedule, due.first[w] + k, tick, tick_s)
                lost[w, agent, slot] = is_lost(row, stream, tick, k, dropout)
                if lost[w, agent, slot]:
                    data[w, agent, slot, :] = 0
