"""Derived figures and the plot of step times over numbers of sensor workers.

All figures of the table are computed here from raw series. The standard deviation within a run
describes the steps of a run (divisor n - 1). The interval between runs describes the differences of
runs, and needs at least five runs. Numbers of workers that were not measured are not predicted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path

import numpy as np

from cavmarl.core.errors import ConfigError, require
from cavmarl.evaluate.statistics import Interval, mean_interval
from cavmarl.evaluate.traffic.traffic_plot import save_figure

MIN_RUNS = 5  # smallest number of runs for an interval between runs
FPS, STEP = "#2f6db5", "#d1793b"
HEADROOM = 1.1  # end of the axis / largest value


@dataclass(frozen=True)
class Series:
    """The steps of one run."""

    step_ms: Sequence[float]  # tick and sensors, per step
    wait_ms: Sequence[float]  # part of `step_ms` that waits for sensors


@dataclass(frozen=True)
class Measured:
    """Mean measurements with one number of sensor workers."""

    workers: int  # n
    step_ms: float  # T, tick and sensors
    sd_within_run: float  # sample standard deviation of steps within a run, ms
    wait_ms: float  # part of T waiting for sensors
    ci95_between_runs: Interval | None = None  # interval of T; None: too few independent runs


@dataclass(frozen=True)
class ScalingRow:
    """Measurements with n sensor workers, and derived figures."""

    workers: int
    step_ms: float
    fps: float  # 1000 / T
    sd_within_run: float
    ci95_between_runs: Interval | None
    wait_ms: float
    speedup: float  # T of the fewest workers / T
    efficiency_pct: float  # speedup / n, times the smallest n
    cv_pct: float  # coefficient of variation: standard deviation / T
    wait_share_pct: float  # waiting time / T
    rest_ms: float  # T minus waiting time
    fps_gain_pct: float  # relative to the FPS of the fewest workers
    step_gain_pct: float  # relative to T of the fewest workers; negative if shorter
    is_best: bool  # whether T is the shortest


def summarize(runs: Mapping[int, Sequence[Series]]) -> list[Measured]:
    """Return means of independent runs, by number of sensor workers.

    The standard deviation is the root of the runs' mean variance, so it excludes differences
    between runs.
    """
    series = [run for of in runs.values() for run in of]
    lengths = {len(part) for run in series for part in (run.step_ms, run.wait_ms)}
    if len(lengths) != 1 or min(lengths) < 2 or not all(runs.values()):
        raise ConfigError(
            f"runs of {sorted(lengths)} steps: every number of workers needs runs, all of equal "
            "length, of at least 2 steps"
        )
    found = []
    for workers, of in sorted(runs.items()):
        steps = np.array([run.step_ms for run in of])
        means = steps.mean(axis=1)
        deviation = float(np.sqrt(steps.var(axis=1, ddof=1).mean()))
        wait_ms = float(np.array([run.wait_ms for run in of]).mean())
        interval = mean_interval(means) if len(of) >= MIN_RUNS else None
        found.append(Measured(workers, float(means.mean()), deviation, wait_ms, interval))
    return found


def scaling_table(
    measured: Sequence[Measured], *, paper_rounding: bool = False
) -> list[ScalingRow]:
    """Compute all derived figures."""
    numbers = [one.workers for one in measured]
    if not numbers or numbers != sorted(set(numbers)) or numbers[0] < 1:
        raise ConfigError(f"sensor workers {numbers}: must be increasing numbers of at least 1")
    for one in measured:
        if not (0.0 < one.step_ms < math.inf and 0.0 <= one.wait_ms <= one.step_ms):
            raise ConfigError(
                f"{one.workers} sensor workers: waited {one.wait_ms:g} ms in a step of "
                f"{one.step_ms:g} ms: must be from 0 to the time of the step"
            )
    rounded: Callable[[float], float] = _to_two_places if paper_rounding else float
    best = min(measured, key=lambda one: one.step_ms)
    return [_row(one, measured[0], one is best, rounded) for one in measured]


def _row(
    one: Measured, first: Measured, is_best: bool, rounded: Callable[[float], float]
) -> ScalingRow:
    fps = rounded(1000.0 / one.step_ms)
    speedup = rounded(first.step_ms / one.step_ms)
    return ScalingRow(
        **vars(one),
        fps=fps,
        speedup=speedup,
        efficiency_pct=rounded(100.0 * speedup * first.workers / one.workers),
        cv_pct=rounded(100.0 * one.sd_within_run / one.step_ms),
        wait_share_pct=rounded(100.0 * one.wait_ms / one.step_ms),
        rest_ms=rounded(one.step_ms - one.wait_ms),
        fps_gain_pct=rounded(100.0 * (fps / rounded(1000.0 / first.step_ms) - 1.0)),
        step_gain_pct=rounded(100.0 * (one.step_ms / first.step_ms - 1.0)),
        is_best=is_best,
    )


def _to_two_places(value: float) -> float:
    """Round half up, based on the number's decimal representation."""
    return float(Decimal(repr(value)).quantize(Decimal("0.01"), ROUND_HALF_UP))


def plot_sensor_workers(rows: Sequence[ScalingRow], title: str, path: Path) -> None:
    """Plot FPS and step time over the number of sensor workers; mark the best."""
    figure = require("matplotlib.figure", "report").Figure(figsize=(7.0, 4.2), layout="constrained")
    left = figure.subplots()
    right = left.twinx()
    numbers = [row.workers for row in rows]
    left.plot(numbers, [row.fps for row in rows], "o-", color=FPS)
    steps_ms, deviations = [row.step_ms for row in rows], [row.sd_within_run for row in rows]
    right.errorbar(numbers, steps_ms, yerr=deviations, fmt="s--", capsize=3.0, color=STEP)
    (best,) = (row for row in rows if row.is_best)
    left.annotate(
        "best", (best.workers, best.fps), (0.0, 8.0), textcoords="offset points", ha="center",
        color=FPS, weight="bold",
    )  # fmt: skip
    for axes, label, color in (
        (left, "frames per second", FPS),
        (right, "tick and sensors, ms (± SD within a run)", STEP),
    ):
        axes.set_ylabel(label, color=color)
        axes.tick_params(axis="y", colors=color)
        axes.set_ylim(0.0, HEADROOM * axes.get_ylim()[1])
    left.set_xlabel("sensor workers")
    left.set_xticks(numbers)
    figure.suptitle(title)
    save_figure(figure, path)
