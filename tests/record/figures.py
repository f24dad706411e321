"""Functions that write the cells of score tables.

A `Figure` takes the evaluation report of one driver and returns the text of a cell.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cavmarl.evaluate import EvaluationReport
from cavmarl.evaluate.metrics import METRICS
from cavmarl.evaluate.report import Found, PolicyReport
from cavmarl.evaluate.statistics import Interval, mean_interval

NONE = "-"

Figure = Callable[[EvaluationReport], str]

_METRICS = {metric.name: metric for metric in METRICS}


def trips(report: EvaluationReport) -> str:
    """Return the number of trips that count."""
    return f"{driver_report(report).trips:,}"


def figure(
    name: str, unit: str = "", *, decimals: int = 1, interval: str = "", interval_decimals: int = 1
) -> Figure:
    """Return a function that writes the mean and the 95 % confidence interval of a metric.

    Args:
        name: the metric.
        unit: unit after the mean, with a leading space; empty if the column title has the unit.
        decimals: number of decimals of the mean.
        interval: "[]" writes both ends, "±" half of the width, "" no interval.
        interval_decimals: number of decimals of the interval.
    """
    scale = _METRICS[name].scale

    def write(report: EvaluationReport) -> str:
        found = driver_report(report)[name]
        if found.mean is None:
            return NONE
        mean = scale * found.mean
        text = f"{number(mean, decimals)}{unit}"
        if found.interval is None or not interval:
            return text
        return text + _interval_text(mean, scale, found.interval, interval, interval_decimals)

    return write


def share(name: str, *, decimals: int = 1) -> Figure:
    """Return a function that writes a share in per cent, and its interval in brackets."""
    return figure(name, " %", decimals=decimals, interval="[]")


def distance_per_infraction(report: EvaluationReport) -> str:
    """Return the distance driven per infraction in km, with one decimal below 100 km."""
    km = driver_report(report)["km_per_infraction"].mean
    return NONE if km is None else f"{km:,.1f} km" if km < 100.0 else f"{km:,.0f} km"


def worst_map(report: EvaluationReport) -> str:
    """Return the lowest success rate of a map, and the name of that map."""
    ((row, *_),) = report.by_map.values()
    return f"{100.0 * row['success']:.1f} % (`{row['map']}`)"


def by_map(report: EvaluationReport) -> dict[str, dict[str, str]]:
    """Return the shares of each map in per cent, starting with the lowest success rate."""
    (rows,) = report.by_map.values()
    shares = ("success", "collision", "red_light")
    return {
        row["map"]: {name: f"{number(100.0 * row[name], 1)} %" for name in shares} for row in rows
    }


def difference(name: str, first: EvaluationReport, second: EvaluationReport) -> str:
    """Return the mean difference first - second of a metric, and its interval over paired runs."""
    scale = _METRICS[name].scale
    runs = zip(*map(_run_means, (first, second), (name, name)), strict=True)
    differences = np.array([scale * (a - b) for a, b in runs])
    text = f"{differences.mean():.1f}"
    found = mean_interval(differences)
    return text if found is None else f"{text} [{found.low:.1f}, {found.high:.1f}]"


def number(value: float, decimals: int) -> str:
    """Return a number as text; a positive number has two decimals if one decimal would show 0.0."""
    is_hidden = decimals == 1 and value > 0.0 and f"{value:.1f}" == "0.0"
    return f"{value:,.{2 if is_hidden else decimals}f}"


def driver_report(report: EvaluationReport) -> PolicyReport:
    """Return the results of the only driver in a report."""
    (found,) = report.policies.values()
    return found


def _run_means(report: EvaluationReport, name: str) -> list[float]:
    found: Found = driver_report(report)[name]
    return [run.mean for run in found.within_run if run.mean is not None]


def _interval_text(mean: float, scale: float, found: Interval, style: str, decimals: int) -> str:
    low, high = scale * found.low, scale * found.high
    if style == "±":
        return f" ± {high - mean:.{decimals}f}"
    if f"{high:.{decimals}f}" == f"{0.0:.{decimals}f}":  # then the mean is 0, too
        return ""
    return f" [{low:.{decimals}f}, {high:.{decimals}f}]"
