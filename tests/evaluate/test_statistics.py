"""Intervals, shares and evenness against textbooks and against slow twins."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.evaluate.statistics import (
    gini_coefficient,
    jain_index,
    mean_interval,
    share_interval,
    student_quantile,
    within_run,
)


@pytest.mark.parametrize(
    ("freedom", "quantile"),
    # Abramowitz and Stegun 1964, table 26.10.
    [(1, 12.706), (2, 4.303), (3, 3.182), (4, 2.776), (9, 2.262), (30, 2.042), (120, 1.980)],
)
def test_students_quantile_equals_the_textbook(freedom: int, quantile: float) -> None:
    assert student_quantile(freedom) == pytest.approx(quantile, abs=5e-4)


@pytest.mark.parametrize("runs", [2, 3, 5])
def test_the_interval_between_runs_covers_as_often_as_it_says(runs: int) -> None:
    random = np.random.default_rng(runs)
    hits = 0
    for _ in range(1000):
        found = mean_interval(random.normal(5.0, 2.0, runs))
        assert found is not None
        hits += found.low <= 5.0 <= found.high
    assert 930 <= hits <= 970


@pytest.mark.parametrize("runs", [0, 1])
def test_fewer_than_two_runs_have_no_interval(runs: int) -> None:
    assert mean_interval(np.ones(runs)) is None


def test_the_spread_within_a_run_is_no_interval() -> None:
    found = within_run(np.array([1.0, 2.0, np.nan, 6.0]), share=False)
    assert (found.n, found.mean, found.wilson95) == (3, 3.0, None)
    assert found.sd == pytest.approx(math.sqrt(7.0))
    assert within_run(np.array([np.nan]), share=True).mean is None


def test_wilson_equals_the_textbook() -> None:
    # Newcombe 1998, table I: 81 of 263 and 15 of 148.
    for hits, total, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605)):
        found = share_interval(hits, total)
        assert found is not None
        assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)
    assert share_interval(0, 0) is None


@pytest.mark.parametrize("hits", [0, 10])
def test_wilson_stays_a_share(hits: int) -> None:
    found = share_interval(hits, 10)
    assert found is not None
    assert 0.0 <= found.low < found.high <= 1.0


VALUES = st.lists(st.floats(0.0, 1e3), min_size=1, max_size=12).map(np.array)


@given(VALUES)
def test_gini_equals_the_sum_over_all_pairs(values: np.ndarray) -> None:
    found = gini_coefficient(values)
    if values.sum() <= 0.0:
        assert math.isnan(found)
        return
    pairs = sum(abs(a - b) for a in values for b in values)
    assert found == pytest.approx(pairs / (2.0 * values.size**2 * values.mean()), abs=1e-9)


def test_jain_is_one_where_all_have_the_same_and_falls_to_one_over_n() -> None:
    assert jain_index(np.full(5, 3.0)) == pytest.approx(1.0)
    assert jain_index(np.array([7.0, 0.0, 0.0, 0.0])) == pytest.approx(0.25)
    # Jain, Chiu and Hawe 1984: k of n users served alike have the index k/n.
    assert jain_index(np.array([2.0] * 3 + [0.0] * 7)) == pytest.approx(0.3)
    assert math.isnan(jain_index(np.zeros(3)))
