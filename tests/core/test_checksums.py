"""Checksums of many bytes."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from cavmarl.core.math.checksums import LARGE, checksum


def test_of_few_bytes_it_is_the_crc() -> None:
    assert checksum(b"abc") == zlib.crc32(b"abc")


@pytest.mark.parametrize("size", [LARGE, LARGE + 8, LARGE + 8 * 3 + 5])
def test_each_bit_and_its_place_count(size: int) -> None:
    drawn = np.random.default_rng(size)
    data = bytearray(drawn.bytes(size))
    sums = {checksum(data), checksum(data[:-1]), checksum(data + b"\0")}
    for bit in range(0, 8 * size, 7):
        data[bit // 8] ^= 1 << bit % 8
        sums.add(checksum(data))
        data[bit // 8] ^= 1 << bit % 8
    words = np.frombuffer(bytes(data[: size // 8 * 8]), np.uint64)
    for first, second in ((0, 1), (0, 4), (1, 5), (3, len(words) - 1)):
        swapped = words.copy()
        swapped[[first, second]] = words[[second, first]]
        sums.add(checksum(swapped.tobytes() + data[size // 8 * 8 :]))
    assert len(sums) == 3 + len(range(0, 8 * size, 7)) + 4
    assert all(0 <= found < 1 << 32 for found in sums)


def test_it_is_the_same_wherever_the_bytes_are() -> None:
    data = np.random.default_rng(0).bytes(LARGE + 3)
    assert checksum(data) == checksum(bytearray(data)) == checksum(memoryview(b"abc" + data)[3:])
