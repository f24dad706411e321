"""Digests of rows depend on every bit of the state, but not on the order of rows or on zones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.driving.vehicles import PLACEMENT_FIELDS, STATE_FIELDS, VEHICLE
from cavmarl.handoff.coordinator.row_digests import RowDigests
from cavmarl.handoff.kernels.digests import digest_rows
from tests.naive import digests as naive

# In uncompiled kernels, NumPy warns of products that overflow, which is intended here.
pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered in scalar:RuntimeWarning")

WORDS = st.integers(0, (1 << 64) - 1)


@given(st.lists(st.tuples(WORDS, WORDS, WORDS), max_size=12), st.tuples(WORDS, WORDS, WORDS))
def test_the_digest_equals_its_plain_twin(
    rows: list[tuple[int, int, int]], masks: tuple[int, int, int]
) -> None:
    factors = [0x9E3779B97F4A7C15, 1, (1 << 64) - 1]
    words = np.array([*rows, (1, 2, 3)], dtype=np.uint64)  # the last row does not count
    upper, lower = digest_rows(
        words, len(rows), np.array(masks, np.uint64), np.array(factors, np.uint64)
    )
    expected = naive.digest([list(row) for row in rows], list(masks), factors)
    assert (int(upper) << 64) + int(lower) == expected


def test_the_sum_of_digests_carries_from_the_lower_to_the_upper_word() -> None:
    word = next(w for w in range(1000) if naive.mixed(w) > 1 << 63)
    words = np.full((4, 1), word, dtype=np.uint64)
    all_bits, one = np.array([(1 << 64) - 1], np.uint64), np.array([1], np.uint64)
    upper, lower = digest_rows(words, 4, all_bits, one)
    assert upper >= 2
    assert (int(upper) << 64) + int(lower) == 4 * naive.mixed(word)


def cars(number: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    rows = np.zeros(number, dtype=VEHICLE)
    for name in VEHICLE.names or ():
        rows[name] = rng.integers(0, 1000, number)
    return rows


def test_the_digest_of_a_world_is_the_same_in_all_divisions() -> None:
    rows, of = cars(20), RowDigests().of
    rng = np.random.default_rng(4)
    for cut in (0, 1, 7, 20):
        order = rng.permutation(20)
        assert of(rows[order[:cut]]) + of(rows[order[cut:]]) == of(rows)


@pytest.mark.parametrize("name", VEHICLE.names or ())
def test_a_digest_depends_on_every_state_field_and_on_no_other_field(name: str) -> None:
    rows, of = cars(3), RowDigests().of
    before = of(rows)
    field = rows[name]
    field[1] = np.nextafter(field[1], 2e3) if field.dtype.kind == "f" else field[1] + 1
    assert (of(rows) != before) == (name in STATE_FIELDS)
    assert (of(rows) == before) == (name in PLACEMENT_FIELDS)
