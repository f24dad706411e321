"""Least squares with coefficients that cannot be below 0, for a handful of columns."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError

__all__ = ["MAX_COLUMNS", "fit_non_negative"]

Floats = NDArray[np.float64]
MAX_COLUMNS = 8  # all subsets are tried


def fit_non_negative(rows: Floats, values: Floats) -> Floats:
    """Coefficients (c,) ≥ 0 that minimise |rows · coefficients - values|².

    The optimum is an ordinary least-squares fit on the columns that are not at 0 (Lawson and
    Hanson, Solving Least Squares Problems, 1974, chapter 23). For few columns all choices of them
    are tried, and the best fit without a negative coefficient is the answer.

    Args:
        rows: (n, c), c at most `MAX_COLUMNS`.
        values: (n,).

    Raises:
        ConfigError: no rows, too many columns, or something that is no number.
    """
    rows, values = np.asarray(rows, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if rows.ndim != 2 or not len(rows) or len(rows) != len(values):
        raise ConfigError(f"a fit of {rows.shape} rows to {values.shape}: one value a row")
    if rows.shape[1] > MAX_COLUMNS:
        raise ConfigError(f"a fit of {rows.shape[1]} columns: at most {MAX_COLUMNS}")
    if not (np.isfinite(rows).all() and np.isfinite(values).all()):
        raise ConfigError("a fit to values that are not finite: leave these rows out")
    columns = range(rows.shape[1])
    best, least = np.zeros(len(columns)), float(values @ values)
    for size in range(1, len(columns) + 1):
        for chosen in combinations(columns, size):
            some = np.linalg.lstsq(rows[:, chosen], values, rcond=None)[0]
            if (some < 0.0).any():
                continue
            error = float(((rows[:, chosen] @ some - values) ** 2).sum())
            if error < least:
                least = error
                best = np.zeros(len(columns))
                best[list(chosen)] = some
    return best
