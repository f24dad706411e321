"""Intervals, shares and evenness equal textbooks and plain computations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.evaluate.metrics import METRICS, least_value
from cavmarl.evaluate.statistics import (
    bounded_interval,
    gini_coefficient,
    jain_index,
    mean_interval,
    run_share_interval,
    share_interval,
    student_quantile,
    within_run,
)
from cavmarl.evaluate.tables import TRIP


@pytest.mark.parametrize(
    ("freedom", "quantile"),
    # Values of Abramowitz and Stegun 1964, table 26.10.
    [(1, 12.706), (2, 4.303), (3, 3.182), (4, 2.776), (9, 2.262), (30, 2.042), (120, 1.980)],
)
def test_students_quantile_equals_the_textbook(freedom: int, quantile: float) -> None:
    assert student_quantile(freedom) == pytest.approx(quantile, abs=5e-4)


@pytest.mark.parametrize("runs", [2, 3, 5])
def test_the_interval_between_runs_has_its_stated_coverage(runs: int) -> None:
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


def test_the_standard_deviation_within_a_run_gives_no_interval() -> None:
    found = within_run(np.array([1.0, 2.0, np.nan, 6.0]), share=False)
    assert (found.n, found.mean, found.wilson95) == (3, 3.0, None)
    assert found.sd == pytest.approx(math.sqrt(7.0))
    assert within_run(np.array([np.nan]), share=True).mean is None


def test_wilson_intervals_equal_the_textbook() -> None:
    # Examples of Newcombe 1998, table I.
    for hits, total, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605)):
        found = share_interval(hits, total)
        assert found is not None
        assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)
    assert share_interval(0, 0) is None


@pytest.mark.parametrize("hits", [0, 10])
def test_wilson_intervals_stay_between_0_and_1(hits: int) -> None:
    found = share_interval(hits, 10)
    assert found is not None
    assert 0.0 <= found.low < found.high <= 1.0


@pytest.mark.parametrize(("share", "ends"), [(0.0, (0.0, 0.0410)), (1.0, (0.9590, 1.0))])
def test_intervals_of_runs_without_a_hit_or_without_a_miss_have_a_width(
    share: float, ends: tuple[float, float]
) -> None:
    # The upper end of Wilson's interval for 0 of 90 is z² / (90 + z²).
    found = run_share_interval(np.full(3, share), 90)
    assert found is not None
    assert (found.low, found.high) == pytest.approx(ends, abs=1e-4)
    assert run_share_interval(np.full(1, share), 30) is None


def test_equal_runs_have_the_interval_of_a_single_run() -> None:
    found, trips = run_share_interval(np.full(2, 0.3), 20), share_interval(6, 20)
    assert found == trips
    # There are 100 trips in all runs. Although the runs are nearly equal, an interval of ±1 % would
    # be too narrow.
    found = run_share_interval(np.array([0.3, 0.3, 0.3, 0.3, 0.31]), 100)
    assert found is not None
    assert found.low < 0.23
    assert found.high > 0.39


@pytest.mark.parametrize("runs", [2, 3, 5])
@pytest.mark.parametrize("share", [0.02, 0.3])
@pytest.mark.parametrize("alike", [1e9, 20.0], ids=["like one run", "runs differ"])
def test_an_interval_of_shares_has_its_coverage_and_stays_between_0_and_1(
    runs: int, share: float, alike: float
) -> None:
    """Each run has 50 trips and a success probability from a beta distribution."""
    random, hits = np.random.default_rng(runs), 0
    for _ in range(1000):
        chances = random.beta(alike * share, alike * (1.0 - share), runs)
        found = run_share_interval(random.binomial(50, chances) / 50.0, 50 * runs)
        assert found is not None
        assert 0.0 <= found.low < found.high <= 1.0
        hits += found.low <= share <= found.high
    assert hits >= 900  # fewer than 950, because shares near 0 are not normally distributed


def test_an_interval_of_a_bounded_metric_stays_within_its_bounds() -> None:
    for values in ([0.98, 1.0, 0.99], [0.99, 1.0], [0.26, 0.25], [0.3, 1.0]):
        means = np.array(values)
        found = bounded_interval(means, 0.25)
        assert found is not None
        assert 0.25 < found.low < means.mean() < found.high < 1.0
    middle = np.array([0.60, 0.61, 0.59, 0.60])
    found, plain = bounded_interval(middle, 0.25), mean_interval(middle)
    assert found is not None
    assert plain is not None
    assert (found.low, found.high) == pytest.approx((plain.low, plain.high), abs=1e-3)


def test_equal_values_in_all_runs_give_no_interval() -> None:
    for value in (1.0, 0.25, 0.7):
        assert mean_interval(np.array([value, value, value * (1.0 + 1e-15)])) is None
        assert bounded_interval(np.full(3, value), 0.25) is None
    assert bounded_interval(np.ones(3), 1.0) is None, (
        "a metric whose least value is 1 has an interval"
    )
    assert mean_interval(np.zeros(3)) is None


def test_the_least_value_of_jains_index_is_one_over_the_trips_of_an_episode() -> None:
    trips = np.zeros(7, TRIP)
    trips["episode"] = [0, 0, 0, 1, 1, 1, 1]
    trips["run"] = [0, 1, 1, 0, 0, 0, 0]
    trips["counted"] = [1, 1, 1, 1, 1, 1, 0]
    metrics = {metric.name: metric for metric in METRICS}
    assert least_value(metrics["jain_speed"], trips) == pytest.approx(1.0 / 3.0)
    assert least_value(metrics["jain_speed"], trips[:0]) == 1.0
    assert least_value(metrics["success"], trips) == 0.0


VALUES = st.lists(st.floats(0.0, 1e3), min_size=1, max_size=12).map(np.array)


@given(VALUES)
def test_gini_equals_the_sum_over_all_pairs(values: np.ndarray) -> None:
    found = gini_coefficient(values)
    if values.sum() <= 0.0:
        assert math.isnan(found)
        return
    pairs = sum(abs(a - b) for a in values for b in values)
    assert found == pytest.approx(pairs / (2.0 * values.size**2 * values.mean()), abs=1e-9)


def test_jains_index_is_k_over_n_if_k_of_n_values_are_equal_and_the_others_0() -> None:
    assert jain_index(np.full(5, 3.0)) == pytest.approx(1.0)
    assert jain_index(np.array([7.0, 0.0, 0.0, 0.0])) == pytest.approx(0.25)
    # Source: Jain, Chiu and Hawe 1984.
    assert jain_index(np.array([2.0] * 3 + [0.0] * 7)) == pytest.approx(0.3)
    assert math.isnan(jain_index(np.zeros(3)))
