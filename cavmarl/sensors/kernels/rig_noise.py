"""Errors of mounted sensors, as a function of vehicle, tick, sensor and draw alone.

A sensor's random numbers have a key of their own, mixed from that of the vehicle and the stream of
the sensor, so that no two sensors share numbers and another sensor in the rig changes none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import TWO_PI
from cavmarl.core.math.rng import mix, quick_uniform
from cavmarl.core.numba import kernel

# Numbers of draws, apart from those of the samples' numbers.
_BIAS = 1 << 28
_DROPOUT = 1 << 29


class Noise(NamedTuple):
    """How wrong a sensor is."""

    stream: np.uint64
    noise: NDArray[np.float64]  # (channels,) standard deviation of each sample
    bias: NDArray[np.float64]  # (channels,) of what stays the same for a vehicle's episode


@kernel
def sensor_key(row: np.void, stream: np.uint64) -> np.uint64:
    """The key of a sensor's random numbers on a vehicle."""
    return mix(row["rng_key"] ^ stream)


@kernel
def gauss(key: np.uint64, vehicle: int, tick: int, draw: int) -> float:
    """A standard normal number.

    Box and Muller: "A note on the generation of random normal deviates", 1958.

    `draw`: which one of this tick, below 2**30.
    """
    radius = math.sqrt(-2.0 * math.log(1.0 - quick_uniform(key, vehicle, tick, 2 * draw)))
    return radius * math.cos(TWO_PI * quick_uniform(key, vehicle, tick, 2 * draw + 1))


@kernel
def error_of(
    noise: Noise, key: np.uint64, vehicle: int, tick: int, draw: int, channel: int
) -> float:
    """What is added to a number that a sensor measures.

    `draw`: number of the measured number among those of this tick, below 2**28. `channel`: which
    one it belongs to.
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
    """Add to each channel of a sample (channels,) its error.

    `row`: VEHICLE that carries it. `sample`: its number among those of the tick. `out`: the sample,
    one number a channel.
    """
    key = sensor_key(row, noise.stream)
    for channel in range(out.size):
        draw = sample * out.size + channel
        out[channel] += error_of(noise, key, row["id"], tick, draw, channel)


@kernel
def is_lost(row: np.void, stream: np.uint64, tick: int, sample: int, dropout: float) -> bool:
    """Whether a sample of a tick is lost, with the chance of `dropout`."""
    if dropout <= 0.0:
        return False
    key = sensor_key(row, stream)
    return quick_uniform(key, row["id"], tick, _DROPOUT + sample) < dropout
