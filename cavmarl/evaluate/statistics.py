"""Statistics: intervals between runs, spread within a run, shares, inequality."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import atan, cos_sin

Z_95 = 1.959963984540054
TWO_SIDED = 0.975  # share of the distribution below the upper end of a 95 % interval
ROUNDING = 1e-12  # values that differ by less than this share are equal

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """The ends of a 95 % confidence interval."""

    low: float
    high: float


@dataclass(frozen=True)
class Within:
    """Mean and spread of the values of one run."""

    n: int  # number of trips or episodes
    mean: float | None  # None without values
    # sample standard deviation; None with fewer than two. It is the spread of trips or episodes and
    # says nothing about how another run would come out.
    sd: float | None
    wilson95: Interval | None  # shares only, of independent trips of one run (Wilson 1927)


def within_run(values: Values, *, share: bool) -> Within:
    """Return mean and spread of the values (N,) of one run; NaN counts as no value."""
    values = values[~np.isnan(values)]
    if not values.size:
        return Within(0, None, None, None)
    mean = float(values.mean())
    sd = float(values.std(ddof=1)) if values.size > 1 else None
    wilson = share_interval(round(float(values.sum())), values.size) if share else None
    return Within(values.size, mean, sd, wilson)


def mean_interval(means: Values) -> Interval | None:
    """Return the interval of the mean of independent runs (R,) by Student's t.

    mean ± t(0.975, R - 1) · sd / √R, with the standard deviation sd of the run means. None for
    fewer than two runs, or if all runs have the same value, which does not show the spread.
    """
    error = _error_of(means)
    if error == 0.0:
        return None
    mean = float(means.mean())
    half = student_quantile(means.size - 1) * error
    return Interval(mean - half, mean + half)


def bounded_interval(means: Values, least: float) -> Interval | None:
    """Return `mean_interval` for values from `least` to 1, limited to this range.

    It is Wilson's interval with Student's t, for the number of trips that would have the same
    standard error as the run means.
    """
    error = _error_of(means) / (1.0 - least) if least < 1.0 else 0.0
    if error == 0.0:
        return None
    share = (float(means.mean()) - least) / (1.0 - least)
    number = share * (1.0 - share) / error**2
    found = _wilson(share, number, student_quantile(means.size - 1))
    return Interval(least + (1.0 - least) * found.low, least + (1.0 - least) * found.high)


def run_share_interval(shares: Values, total: int) -> Interval | None:
    """Return the interval of the mean of shares (R,) of independent runs.

    Each end is the wider one of `bounded_interval` and Wilson's interval of all trips, so runs that
    happen to agree do not make it too narrow. None for fewer than two runs.
    """
    if shares.size < 2 or total == 0:
        return None
    trips = _wilson(float(shares.mean()), total, Z_95)
    runs = bounded_interval(shares, 0.0) or trips
    return Interval(min(trips.low, runs.low), max(trips.high, runs.high))


def _error_of(means: Values) -> float:
    """Return the standard error of a mean of runs; 0 for fewer than two runs or equal values."""
    if means.size < 2 or float(np.ptp(means)) <= ROUNDING * float(np.abs(means).max()):
        return 0.0
    return float(means.std(ddof=1)) / math.sqrt(means.size)


def share_interval(hits: int, total: int) -> Interval | None:
    """Return the interval of a share by Wilson's score (1927); None without a total."""
    return _wilson(hits / total, total, Z_95) if total else None


def _wilson(share: float, number: float, quantile: float) -> Interval:
    weight = quantile * quantile / number
    centre = (share + weight / 2.0) / (1.0 + weight)
    half = math.sqrt(weight * (share * (1.0 - share) + weight / 4.0)) / (1.0 + weight)
    return Interval(max(centre - half, 0.0), min(centre + half, 1.0))


@cache
def student_quantile(freedom: int) -> float:
    """Return the 0.975 quantile of Student's t for whole degrees of freedom, by bisection."""
    low, high = 0.0, 16.0
    while high - low > 1e-12 * high:
        middle = 0.5 * (low + high)
        if 0.5 + 0.5 * _student_within(middle, freedom) < TWO_SIDED:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _student_within(t: float, freedom: int) -> float:
    """Return P(|T| < t): Abramowitz and Stegun 1964, 26.7.3 and 26.7.4."""
    theta = atan(t / math.sqrt(freedom))
    cos, sin = cos_sin(theta)
    square = cos * cos
    odd = freedom % 2 == 1
    term = cos if odd else 1.0
    total = term if freedom > 1 else 0.0
    for k in range(2 if odd else 1, freedom - 2, 2):
        term *= square * k / (k + 1)
        total += term
    return 2.0 / math.pi * (theta + sin * total) if odd else sin * total


def jain_index(values: Values) -> float:
    """Return Jain's fairness index (Jain, Chiu and Hawe 1984): (Σx)² / (n · Σx²).

    1 if all values are equal, 1/n if one has everything; NaN without values or if all are 0.
    """
    squares = values.size * float((values * values).sum())
    return float(values.sum()) ** 2 / squares if squares > 0.0 else math.nan


def gini_coefficient(values: Values) -> float:
    """Return Gini's coefficient (1912) of values ≥ 0: Σᵢ Σⱼ |xᵢ - xⱼ| / (2 n² · mean).

    0 if all values are equal, near 1 if one has everything; NaN without values or if all are 0.
    """
    total = float(values.sum())
    if total <= 0.0:
        return math.nan
    ranks = np.arange(1, values.size + 1)
    weighted = float(((2.0 * ranks - values.size - 1.0) * np.sort(values)).sum())
    return weighted / (values.size * total)
