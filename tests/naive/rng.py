"""Philox4x32-10 with Python integers, as in the paper."""

from __future__ import annotations

from tests.naive.digests import mixed

MASK_32 = (1 << 32) - 1


def philox4x32(counter: list[int], key: list[int]) -> list[int]:
    """Compute ten rounds, each of two 32 x 32 -> 64 bit multiplications."""
    for _ in range(10):
        high_0, low_0 = divmod(counter[0] * 0xD2511F53, 1 << 32)
        high_1, low_1 = divmod(counter[2] * 0xCD9E8D57, 1 << 32)
        counter = [high_1 ^ counter[1] ^ key[0], low_1, high_0 ^ counter[3] ^ key[1], low_0]
        key = [(key[0] + 0x9E3779B9) & MASK_32, (key[1] + 0xBB67AE85) & MASK_32]
    return counter


def random_bits(key: int, vehicle: int, tick: int, stream: int) -> int:
    """Return words 0 (upper half) and 1; counters are laid out as in `kernels.rng`."""
    counter = [vehicle & MASK_32, tick & MASK_32, (vehicle >> 32) | (tick >> 32) << 16, stream]
    words = philox4x32(counter, [key & MASK_32, key >> 32])
    return words[0] << 32 | words[1]


def uniform(key: int, vehicle: int, tick: int, stream: int) -> float:
    """Return a uniform number from the upper 27 and 26 bits of the first two words."""
    bits = random_bits(key, vehicle, tick, stream)
    return ((bits >> 32 >> 5) * 2**26 + ((bits & MASK_32) >> 6)) / 2**53


def below(key: int, vehicle: int, tick: int, stream: int, n: int) -> int:
    """Return the 64 bits as a fraction of 1, times n, rounded down."""
    return random_bits(key, vehicle, tick, stream) * n >> 64


def world_key(seed: int, world: int, episode: int) -> int:
    """Return the first two words as one number, with word 1 as the upper half."""
    bits = random_bits(seed, world, episode, 0)
    return (bits & MASK_32) << 32 | bits >> 32


MASK_64 = (1 << 64) - 1
GOLDEN = 0x9E3779B97F4A7C15


def quick_uniform(key: int, vehicle: int, tick: int, stream: int) -> float:
    """Mix key, vehicle and (stream, tick) in turn; return the upper 53 bits as a fraction."""
    word = mixed((key + GOLDEN) & MASK_64)
    word = mixed(word ^ vehicle * GOLDEN & MASK_64)
    word = mixed(word ^ ((stream << 32) + tick) * GOLDEN & MASK_64)
    return (word >> 11) / 2**53
