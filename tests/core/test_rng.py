"""Random numbers, compared with their twins: plain implementations in `tests/naive`."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.core.math import rng
from tests.naive import rng as naive

KEYS = st.integers(0, 2**64 - 1)
NUMBERS = st.integers(0, 2**48 - 1)
STREAMS = st.integers(0, 2**32 - 1)

# SplitMix64 computes modulo 2**64. Without the compiler, NumPy warns of the overflow.
allows_overflow = pytest.mark.filterwarnings("ignore:overflow encountered in scalar:RuntimeWarning")


# Source: the file `kat_vectors` of Random123, lines "philox4x32 10".
@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ("00000000 00000000 00000000 00000000", "00000000 00000000",
         "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff",
         "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0",
         "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)  # fmt: skip
def test_philox_gives_the_published_numbers(counter: str, key: str, answer: str) -> None:
    words = [np.uint64(int(word, 16)) for word in (counter + " " + key).split()]
    block = rng.philox4x32(*words)
    assert " ".join(f"{int(word):08x}" for word in block) == answer
    plain = naive.philox4x32([int(word) for word in words[:4]], [int(word) for word in words[4:]])
    assert plain == [int(word) for word in block]


@given(KEYS, NUMBERS, NUMBERS, STREAMS)
def test_uniform_equals_twin(key: int, vehicle: int, tick: int, stream: int) -> None:
    number = rng.uniform(np.uint64(key), vehicle, tick, stream)
    assert number == naive.uniform(key, vehicle, tick, stream)
    assert 0.0 <= number < 1.0


@given(KEYS, NUMBERS, NUMBERS, STREAMS, st.integers(1, 2**32 - 1))
def test_below_equals_twin(key: int, vehicle: int, tick: int, stream: int, n: int) -> None:
    number = rng.below(np.uint64(key), vehicle, tick, stream, n)
    assert number == naive.below(key, vehicle, tick, stream, n)
    assert 0 <= number < n


@given(KEYS, NUMBERS, NUMBERS)
def test_world_key_equals_twin(seed: int, world: int, episode: int) -> None:
    assert rng.world_key(np.uint64(seed), world, episode) == naive.world_key(seed, world, episode)


def test_a_change_of_any_argument_changes_the_number() -> None:
    base = (np.uint64(7), 3, 5, rng.STREAM_ROUTE)
    numbers = {
        rng.uniform(*base),
        rng.uniform(np.uint64(8), *base[1:]),
        rng.uniform(np.uint64(7 + 2**32), *base[1:]),
        rng.uniform(base[0], 3 + 2**32, 5, rng.STREAM_ROUTE),
        rng.uniform(base[0], 3, 5 + 2**32, rng.STREAM_ROUTE),
        rng.uniform(base[0], 5, 3, rng.STREAM_ROUTE),
        rng.uniform(base[0], 3, 5, rng.STREAM_ROUTE + 1),
    }
    assert len(numbers) == 7


def test_the_draws_of_two_streams_do_not_overlap() -> None:
    streams = sorted(getattr(rng, name) for name in vars(rng) if name.startswith("STREAM_"))
    assert np.all(np.diff(streams) >= rng.DRAWS_PER_STREAM)


def test_numbers_are_uniform() -> None:
    key = np.uint64(rng.world_key(1, 2, 3))
    numbers = [rng.uniform(key, vehicle, 9, rng.STREAM_PLACE) for vehicle in range(4000)]
    counts, _ = np.histogram(numbers, bins=16, range=(0.0, 1.0))
    chi_squared = float(np.sum((counts - 250.0) ** 2) / 250.0)
    assert chi_squared < 37.7  # the 99.9 % quantile for 15 degrees of freedom


@allows_overflow
@given(KEYS, NUMBERS, st.integers(0, 2**32 - 1), STREAMS)
def test_quick_uniform_equals_twin(key: int, vehicle: int, tick: int, stream: int) -> None:
    number = rng.quick_uniform(np.uint64(key), vehicle, tick, stream)
    assert number == naive.quick_uniform(key, vehicle, tick, stream)
    assert 0.0 <= number < 1.0


def quick_numbers(vehicles: range, ticks: range) -> list[float]:
    key = np.uint64(rng.world_key(1, 2, 3))
    return [rng.quick_uniform(key, v, t, rng.STREAM_DRIVER) for v in vehicles for t in ticks]


@allows_overflow
@pytest.mark.parametrize(("vehicles", "ticks"), [(range(4000), range(1)), (range(1), range(4000))])
def test_quick_numbers_are_uniform_and_uncorrelated(vehicles: range, ticks: range) -> None:
    numbers = np.array(quick_numbers(vehicles, ticks))
    counts, _ = np.histogram(numbers, bins=16, range=(0.0, 1.0))
    # The 99.9 % quantile for 15 degrees of freedom.
    assert float(np.sum((counts - 250.0) ** 2) / 250.0) < 37.7
    pairs, _, _ = np.histogram2d(numbers[:-1], numbers[1:], bins=4, range=[(0, 1), (0, 1)])
    assert float(np.sum((pairs - 3999 / 16) ** 2) / (3999 / 16)) < 37.7
    for lag in (1, 2, 7):
        assert abs(np.corrcoef(numbers[:-lag], numbers[lag:])[0, 1]) < 0.06


@allows_overflow
def test_quick_numbers_depend_on_each_argument_and_not_on_earlier_calls() -> None:
    asked = [(v, t) for v in range(30) for t in range(30)]
    key = np.uint64(rng.world_key(1, 2, 3))
    forward = {a: rng.quick_uniform(key, *a, rng.STREAM_DRIVER) for a in asked}
    backward = {a: rng.quick_uniform(key, *a, rng.STREAM_DRIVER) for a in reversed(asked)}
    assert forward == backward
    assert len(set(forward.values())) == len(asked)
    assert rng.quick_uniform(key, 1, 1, rng.STREAM_ROUTE) not in forward.values()
    assert (
        rng.quick_uniform(np.uint64(rng.world_key(1, 2, 4)), 1, 1, rng.STREAM_DRIVER)
        != forward[1, 1]
    )
