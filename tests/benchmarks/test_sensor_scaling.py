"""Derived figures of a scaling table equal those of a published table and their definitions."""

from __future__ import annotations

import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.sensor_scaling import (
    MIN_RUNS,
    Measured,
    ScalingRow,
    Series,
    scaling_table,
    summarize,
)
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.statistics import student_quantile

# Measured values of a published benchmark of ten sensors on one to four processors.
STEP_MS = (227.08, 122.63, 103.14, 115.55)
SD_MS = (12.07, 8.72, 11.01, 15.71)
WAIT_MS = (223.56, 119.46, 99.88, 111.94)
PRINTED = {
    "fps": (4.40, 8.15, 9.70, 8.65),
    "speedup": (1.00, 1.85, 2.20, 1.97),
    "efficiency_pct": (100.0, 92.50, 73.33, 49.25),
    "cv_pct": (5.32, 7.11, 10.67, 13.60),
    "wait_share_pct": (98.45, 97.41, 96.84, 96.88),
    "rest_ms": (3.52, 3.17, 3.26, 3.61),
}
MEASURED = [
    Measured(n, *values) for n, values in enumerate(zip(STEP_MS, SD_MS, WAIT_MS, strict=True), 1)
]

times = st.floats(0.1, 1e4)


@pytest.fixture
def printed() -> list[ScalingRow]:
    return scaling_table(MEASURED, paper_rounding=True)


@pytest.mark.parametrize("name", PRINTED)
def test_the_published_table_is_reproduced(printed: list[ScalingRow], name: str) -> None:
    assert tuple(getattr(row, name) for row in printed) == PRINTED[name]


def test_the_published_gains_are_reproduced(printed: list[ScalingRow]) -> None:
    assert [row.fps_gain_pct for row in printed[:3]] == [0.0, 85.23, 120.45]
    assert [row.step_gain_pct for row in printed[:3]] == [0.0, -46.00, -54.58]


def test_figures_are_rounded_only_on_request() -> None:
    efficiencies = [round(row.efficiency_pct, 2) for row in scaling_table(MEASURED)]
    assert efficiencies == [100.0, 92.59, 73.39, 49.13]


def test_the_fastest_row_is_marked_although_it_is_not_the_last(printed: list[ScalingRow]) -> None:
    assert [row.is_best for row in printed] == [False, False, True, False]


def test_the_table_has_only_measured_numbers_of_workers(printed: list[ScalingRow]) -> None:
    assert [row.workers for row in scaling_table(MEASURED[::2])] == [1, 3]


@given(st.lists(st.tuples(times, times), min_size=1, max_size=6))
def test_figures_of_a_row_are_consistent(drawn: list[tuple[float, float]]) -> None:
    measured = [
        Measured(n, max(pair), 0.1 * max(pair), min(pair)) for n, pair in enumerate(drawn, 1)
    ]
    rows = scaling_table(measured)
    for row in rows:
        assert row.fps * row.step_ms == pytest.approx(1000.0)
        assert row.speedup * row.step_ms == pytest.approx(rows[0].step_ms)
        assert row.efficiency_pct * row.workers == pytest.approx(100.0 * row.speedup)
        assert row.cv_pct == pytest.approx(10.0)
        assert row.rest_ms + row.wait_ms == pytest.approx(row.step_ms)
        assert row.wait_share_pct * row.step_ms == pytest.approx(100.0 * row.wait_ms)
        assert 1.0 + row.fps_gain_pct / 100.0 == pytest.approx(row.speedup)
        assert row.step_gain_pct == pytest.approx(100.0 * (1.0 / row.speedup - 1.0))
    (best,) = (row for row in rows if row.is_best)
    assert best.step_ms == min(row.step_ms for row in rows)


@given(st.lists(st.lists(times, min_size=3, max_size=3), min_size=1, max_size=MIN_RUNS + 2))
def test_deviations_within_runs_and_intervals_between_runs_are_computed(
    drawn: list[list[float]],
) -> None:
    (row,) = summarize({2: [Series(run, [0.5 * step for step in run]) for run in drawn]})
    means = [statistics.fmean(run) for run in drawn]
    variances = [statistics.variance(run) for run in drawn]
    assert row.step_ms == pytest.approx(statistics.fmean(means))
    assert row.wait_ms == pytest.approx(0.5 * row.step_ms)
    rounding = 1e-12 * row.step_ms  # error of the mean of equal times, by rounding
    assert row.sd_within_run == pytest.approx(statistics.fmean(variances) ** 0.5, abs=rounding)
    if len(drawn) < MIN_RUNS:
        assert row.ci95_between_runs is None
        return
    assert row.ci95_between_runs is not None
    half = student_quantile(len(drawn) - 1) * statistics.stdev(means) / len(drawn) ** 0.5
    assert row.ci95_between_runs.high == pytest.approx(row.step_ms + half)
    assert row.ci95_between_runs.low == pytest.approx(row.step_ms - half, abs=1e-9 * half)


def test_different_means_of_runs_do_not_change_the_deviation_within_runs() -> None:
    (row,) = summarize({1: [Series([10.0, 12.0], [1.0, 1.0]), Series([90.0, 92.0], [1.0, 1.0])]})
    assert row.sd_within_run == pytest.approx(2.0**0.5)


@pytest.mark.parametrize(
    "runs",
    [
        {},
        {1: []},
        {1: [Series([1.0], [0.5])]},
        {1: [Series([1.0, 2.0], [0.5, 0.5])], 2: [Series([1.0, 2.0, 3.0], [0.5, 0.5, 0.5])]},
        {1: [Series([1.0, 2.0], [0.5])]},
    ],
)
def test_runs_that_cannot_be_compared_are_refused(runs: dict[int, list[Series]]) -> None:
    with pytest.raises(ConfigError, match="every number of workers needs runs"):
        summarize(runs)


@pytest.mark.parametrize(
    "measured",
    [
        [],
        [Measured(0, 1.0, 0.1, 0.5)],
        [Measured(2, 1.0, 0.1, 0.5), Measured(1, 1.0, 0.1, 0.5)],
        [Measured(1, 1.0, 0.1, 1.5)],
        [Measured(1, 0.0, 0.0, 0.0)],
    ],
)
def test_invalid_arguments_are_refused(measured: list[Measured]) -> None:
    with pytest.raises(ConfigError):
        scaling_table(measured)
