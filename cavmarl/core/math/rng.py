"""Random numbers as a pure function of vehicle, time and purpose: Philox4x32-10.

Salmon, Moraes, Dror, Shaw: "Parallel random numbers: as easy as 1, 2, 3", SC 2011. A stateless
generator gives a vehicle the same numbers in every shard, and after every restart.

    key      64 bits   `world_key(seed, world, episode)`
    counter  word 0    vehicle, bits 0-31
             word 1    tick, bits 0-31
             word 2    low half: vehicle, bits 32-47; high half: tick, bits 32-47
             word 3    stream + draw index

A caller that needs several numbers of one stream in one tick uses `STREAM_X`, `STREAM_X + 1`, …,
because the streams below are `DRAWS_PER_STREAM` apart. Every use of random numbers has its own
stream in this list.

Words are stored as uint64, in which the product of two 32-bit numbers cannot overflow. All operands
are uint64: Numba converts a mix with int64 to float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel

DRAWS_PER_STREAM = 1 << 16

STREAM_WORLD = 0 * DRAWS_PER_STREAM  # keys of worlds and episodes
STREAM_ROUTE = 1 * DRAWS_PER_STREAM  # destinations
STREAM_ORIGIN = 2 * DRAWS_PER_STREAM  # where vehicles enter
STREAM_SPEED_FACTOR = 3 * DRAWS_PER_STREAM  # desired speed / speed limit
STREAM_PLACE = 4 * DRAWS_PER_STREAM  # positions at reset
STREAM_DEPARTURE = 5 * DRAWS_PER_STREAM  # times between departures
STREAM_DRIVER = 9 * DRAWS_PER_STREAM  # decisions of background drivers
STREAM_SENSOR = 10 * DRAWS_PER_STREAM  # noise and dropouts of sensors
STREAM_V2X = 11 * DRAWS_PER_STREAM  # losses and delays of messages
STREAM_DEMAND = 12 * DRAWS_PER_STREAM  # times, types and routes of a demand file
STREAM_REROUTER = 13 * DRAWS_PER_STREAM  # which vehicles follow a rerouter, and their new goals
STREAM_MAP = 14 * DRAWS_PER_STREAM  # the map of an episode, if there are several
STREAM_MODEL = 16 * DRAWS_PER_STREAM  # the drivers of the generator's vehicles
STREAM_CAMERA = 15 * DRAWS_PER_STREAM  # vehicles that the cameras of signals miss

_MASK_16 = np.uint64(0xFFFF)
_MASK_32 = np.uint64(0xFFFFFFFF)
_SHIFT_16 = np.uint64(16)
_SHIFT_32 = np.uint64(32)
_MULTIPLIER_0 = np.uint64(0xD2511F53)
_MULTIPLIER_1 = np.uint64(0xCD9E8D57)
_WEYL_0 = np.uint64(0x9E3779B9)  # golden ratio
_WEYL_1 = np.uint64(0xBB67AE85)  # sqrt(3) - 1
_ROUNDS = 10

# SplitMix64's increment and multipliers.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_0 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_1 = np.uint64(0x94D049BB133111EB)
_SHIFT_11 = np.uint64(11)
_SHIFT_27 = np.uint64(27)
_SHIFT_30 = np.uint64(30)
_SHIFT_31 = np.uint64(31)

# The upper 27 and 26 bits of two words make the 53 of a float64.
_SHIFT_5 = np.uint64(5)
_SHIFT_6 = np.uint64(6)
_SHIFT_26 = np.uint64(26)
_ULP = 1.0 / (1 << 53)


@kernel
def philox4x32(
    c0: np.uint64,  # lowest word of the counter; all words are uint64 below 2**32
    c1: np.uint64,  # second word of the counter
    c2: np.uint64,  # third word of the counter
    c3: np.uint64,  # highest word of the counter
    k0: np.uint64,  # low word of the key
    k1: np.uint64,  # high word of the key
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Return one block of Philox4x32-10: four 32-bit words from counter (128 bits) and key (64)."""
    for _ in range(_ROUNDS):
        product_0 = c0 * _MULTIPLIER_0
        product_1 = c2 * _MULTIPLIER_1
        c0 = (product_1 >> _SHIFT_32) ^ c1 ^ k0
        c1 = product_1 & _MASK_32
        c2 = (product_0 >> _SHIFT_32) ^ c3 ^ k1
        c3 = product_0 & _MASK_32
        k0 = (k0 + _WEYL_0) & _MASK_32
        k1 = (k1 + _WEYL_1) & _MASK_32
    return c0, c1, c2, c3


@kernel
def _block(
    key: int | np.uint64, vehicle: int, tick: int, stream: int
) -> tuple[np.uint64, np.uint64]:
    """Return the first two words of a block, with the counter layout of this module."""
    key_bits = np.uint64(key)
    vehicle_bits = np.uint64(vehicle)
    tick_bits = np.uint64(tick)
    high = ((vehicle_bits >> _SHIFT_32) & _MASK_16) | (
        ((tick_bits >> _SHIFT_32) & _MASK_16) << _SHIFT_16
    )
    word_0, word_1, _, _ = philox4x32(
        vehicle_bits & _MASK_32,
        tick_bits & _MASK_32,
        high,
        np.uint64(stream) & _MASK_32,
        key_bits & _MASK_32,
        key_bits >> _SHIFT_32,
    )
    return word_0, word_1


@kernel
def world_key(
    seed: int | np.uint64,  # seed of the run, in [0, 2**64)
    world: int,  # number of the world, in [0, 2**48)
    episode: int,  # number of the episode in that world, in [0, 2**48)
) -> np.uint64:
    """Return the key of one world in one episode, derived from the run's seed."""
    word_0, word_1 = _block(seed, world, episode, STREAM_WORLD)
    return word_0 | (word_1 << _SHIFT_32)


@kernel
def uniform(
    key: int | np.uint64,  # key of the world, see `world_key`
    vehicle: int,  # id of the vehicle, in [0, 2**48)
    tick: int,  # tick of the world, in [0, 2**48)
    stream: int,  # one of `STREAM_*`, plus the index of the draw
) -> float:
    """Return a number with 53 random bits, uniform in [0, 1)."""
    word_0, word_1 = _block(key, vehicle, tick, stream)
    return float(((word_0 >> _SHIFT_5) << _SHIFT_26) | (word_1 >> _SHIFT_6)) * _ULP


@kernel
def fill_uniform(
    key: int | np.uint64,
    vehicles: NDArray[np.int64],
    ticks: NDArray[np.int64],
    stream: int,
    numbers: NDArray[np.float64],
) -> None:
    """Write `uniform` of each pair of `vehicles` (n,) and `ticks` (n,) to `numbers` (n,)."""
    for i in range(len(numbers)):
        numbers[i] = uniform(key, vehicles[i], ticks[i], stream)


@kernel
def below(
    key: int | np.uint64,  # key of the world, see `world_key`
    vehicle: int,  # id of the vehicle, in [0, 2**48)
    tick: int,  # tick of the world, in [0, 2**48)
    stream: int,  # one of `STREAM_*`, plus the index of the draw
    n: int,  # number of values, in [1, 2**32)
) -> int:
    """Return an integer uniform in [0, n); no probability is off by more than 2**-64."""
    word_0, word_1 = _block(key, vehicle, tick, stream)
    count = np.uint64(n)
    # floor(n * (word_0 * 2**32 + word_1) / 2**64), computed in two halves that fit.
    return int((word_0 * count + ((word_1 * count) >> _SHIFT_32)) >> _SHIFT_32)


@kernel
def mix(word: np.uint64) -> np.uint64:
    """Apply the finaliser of SplitMix64: each input bit affects about half of the output bits."""
    word = (word ^ (word >> _SHIFT_30)) * _MIX_0
    word = (word ^ (word >> _SHIFT_27)) * _MIX_1
    return word ^ (word >> _SHIFT_31)


@kernel
def quick_uniform(key: int | np.uint64, vehicle: int, tick: int, stream: int) -> float:
    """Return a uniform number in a fifth of the time of `uniform`, for draws of every tick.

    The finaliser of SplitMix64 (Steele, Lea, Flood: "Fast splittable pseudorandom number
    generators", OOPSLA 2014) over key, vehicle and (stream, tick) in turn.
    """
    word = mix(np.uint64(key) + _GOLDEN)
    word = mix(word ^ (np.uint64(vehicle) * _GOLDEN))
    word = mix(word ^ ((np.uint64(stream) << _SHIFT_32) + np.uint64(tick)) * _GOLDEN)
    return float(word >> _SHIFT_11) * _ULP
