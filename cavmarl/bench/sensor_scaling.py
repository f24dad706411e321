"""What follows from step times over several numbers of sensor workers.

Every figure of such a table is made here, from raw series, and nowhere else. A standard deviation
within a run is that of its steps, by n - 1; it says nothing about another run. What another run
would give is said by the interval between runs, for which there have to be five. Nothing is said
about numbers of workers that have not been measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from decimal import ROUND_HALF_UP, Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.statistics import Interval, mean_interval

MIN_RUNS = 5  # from so many on there is an interval between runs

_PLACES = Decimal("0.01")
_Values = NDArray[np.float64]
_Rounding = Callable[[float], float]


@dataclass(frozen=True)
class Series:
    """The steps of one run."""

    step_ms: Sequence[float]  # tick and sensors, of each step
    wait_ms: Sequence[float]  # of that, waiting for sensors


@dataclass(frozen=True)
class Measured:
    """What has been measured with some number of sensor workers, in the mean."""

    workers: int  # n
    step_ms: float  # T, tick and sensors
    sd_within_run: float  # sample standard deviation of the steps of a run, ms
    wait_ms: float  # of T, waiting for sensors
    # of T, from the means of independent runs; None: too few
    ci95_between_runs: Interval | None = None


@dataclass(frozen=True)
class ScalingRow:
    """What was measured with n sensor workers, and what follows from it."""

    workers: int  # n
    step_ms: float  # T, tick and sensors
    fps: float  # 1000 / T
    sd_within_run: float  # of the steps of a run, ms
    ci95_between_runs: Interval | None  # of T; None: too few runs
    wait_ms: float  # of T, waiting for sensors
    speedup: float  # T of the fewest workers / T
    efficiency_pct: float  # speedup / n, times the fewest workers
    cv_pct: float  # coefficient of variation, standard deviation / T
    wait_share_pct: float  # waiting / T
    rest_ms: float  # T less waiting
    fps_gain_pct: float  # above the FPS of the fewest workers
    step_gain_pct: float  # T above that of the fewest workers; negative where it is shorter
    is_best: bool  # the shortest T of those that were measured

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def summarize(runs: Mapping[int, Sequence[Series]]) -> list[Measured]:
    """Means of independent runs, by the number of sensor workers.

    The standard deviation is the root of the runs' mean variance, so that what lies between the
    runs is not in it.
    """
    lengths = {len(part) for of in runs.values() for run in of for part in _parts(run)}
    if len(lengths) != 1 or min(lengths) < 2 or not all(runs.values()):
        raise ConfigError(
            f"runs of {sorted(lengths)} steps: every number of workers needs runs, all of one "
            "length, of at least 2 steps"
        )
    return [_measured(workers, of) for workers, of in sorted(runs.items())]


def scaling_table(
    measured: Sequence[Measured], *, paper_rounding: bool = False
) -> list[ScalingRow]:
    """Every derived figure."""
    numbers = [one.workers for one in measured]
    if not numbers or numbers != sorted(set(numbers)) or numbers[0] < 1:
        raise ConfigError(f"sensor workers {numbers}: must be rising numbers from 1")
    for one in measured:
        if not (0.0 < one.step_ms < math.inf and 0.0 <= one.wait_ms <= one.step_ms):
            raise ConfigError(
                f"{one.workers} sensor workers: {one.wait_ms:g} ms of {one.step_ms:g} ms cannot be"
            )
    rounded: _Rounding = _to_two_places if paper_rounding else float
    first = measured[0]
    best = min(measured, key=lambda one: one.step_ms)
    return [_row(one, first, one is best, rounded) for one in measured]


def _measured(workers: int, runs: Sequence[Series]) -> Measured:
    steps, waits = (
        np.array([getattr(run, name) for run in runs], dtype=np.float64)
        for name in ("step_ms", "wait_ms")
    )
    means: _Values = steps.mean(axis=1)
    return Measured(
        workers,
        float(means.mean()),
        float(np.sqrt(steps.var(axis=1, ddof=1).mean())),
        float(waits.mean()),
        mean_interval(means) if len(runs) >= MIN_RUNS else None,
    )


def _row(one: Measured, first: Measured, is_best: bool, rounded: _Rounding) -> ScalingRow:
    fps = rounded(1000.0 / one.step_ms)
    speedup = rounded(first.step_ms / one.step_ms)
    return ScalingRow(
        workers=one.workers,
        step_ms=one.step_ms,
        fps=fps,
        sd_within_run=one.sd_within_run,
        ci95_between_runs=one.ci95_between_runs,
        wait_ms=one.wait_ms,
        speedup=speedup,
        efficiency_pct=rounded(100.0 * speedup * first.workers / one.workers),
        cv_pct=rounded(100.0 * one.sd_within_run / one.step_ms),
        wait_share_pct=rounded(100.0 * one.wait_ms / one.step_ms),
        rest_ms=rounded(one.step_ms - one.wait_ms),
        fps_gain_pct=rounded(100.0 * (fps / rounded(1000.0 / first.step_ms) - 1.0)),
        step_gain_pct=rounded(100.0 * (one.step_ms / first.step_ms - 1.0)),
        is_best=is_best,
    )


def _parts(run: Series) -> tuple[Sequence[float], Sequence[float]]:
    return run.step_ms, run.wait_ms


def _to_two_places(value: float) -> float:
    """Halves up, of the number as it is written in decimal."""
    return float(Decimal(repr(value)).quantize(_PLACES, ROUND_HALF_UP))
