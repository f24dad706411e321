"""`EvaluationReport`: the results of an evaluation as frozen values.

Two kinds of spread are kept apart. *Between runs*: each run has its own seed and gives one mean;
the 95 % interval is for the mean over all possible seeds. *Within a run*: the spread of trips or
episodes of one run says nothing about another run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.evaluate.episodes import Speed
from cavmarl.evaluate.map_table import rows_by_map
from cavmarl.evaluate.metrics import (
    INFRACTIONS,
    KM_PER_INFRACTION,
    METRICS,
    Metric,
    least_value,
    metric_values,
)
from cavmarl.evaluate.statistics import (
    Interval,
    Within,
    bounded_interval,
    mean_interval,
    run_share_interval,
    within_run,
)
from cavmarl.ownership.transfer_summary import TransferSummary

NO_INTERVAL = "not available: one run says nothing about the next; use --repeats 2 or more"


@dataclass(frozen=True)
class Found:
    """One metric of one policy."""

    mean: float | None  # mean of the run means; None without data
    # interval of that mean over independent runs; None with fewer than two runs that have the
    # metric, or if all runs have the same value of a metric that is not a share
    between_run_ci95: Interval | None
    within_run: tuple[Within, ...]  # mean and spread of each run

    @property
    def interval(self) -> Interval | None:
        """The interval between several runs, or Wilson's interval of one run (shares only)."""
        if self.between_run_ci95 is not None or len(self.within_run) != 1:
            return self.between_run_ci95
        return self.within_run[0].wilson95

    @property
    def within_sd(self) -> float | None:
        """Spread within a run: root of the mean variance of the runs."""
        variances = [run.sd * run.sd for run in self.within_run if run.sd is not None]
        return float(np.sqrt(np.mean(variances))) if variances else None


@dataclass(frozen=True)
class PairedDifference:
    """The difference of a policy from the first policy, paired by runs with equal seeds."""

    mean: float | None  # mean difference of run means; None without data
    # interval of that mean by Student's t for paired samples; None with fewer than two runs
    between_run_ci95: Interval | None
    runs: tuple[float | None, ...]  # differences by run; None if a value is missing

    @property
    def distinct(self) -> bool:
        """True if the interval excludes 0."""
        found = self.between_run_ci95
        return found is not None and not found.low <= 0.0 <= found.high


@dataclass(frozen=True)
class PolicyReport:
    """All results of one policy."""

    trips: int  # number of counted trips in all runs
    metrics: Mapping[str, Found]  # name in `metrics.METRICS` → results
    # metric → paired difference from the first policy; empty for the first policy
    minus_first: Mapping[str, PairedDifference]
    speed: tuple[Speed, ...]  # speed of each run; not reproducible
    # transfers between zones in all runs; None: undivided worlds. Their times are not repeatable.
    transfers: TransferSummary | None = None

    def __getitem__(self, metric: str) -> Found:
        return self.metrics[metric]

    def is_above(self, metric: Metric) -> bool:
        """Return whether the mean is only a lower bound, because there was no infraction."""
        if metric.name != KM_PER_INFRACTION or self[metric.name].mean is None:
            return False
        return not any(self[name].mean for name in INFRACTIONS)


@dataclass(frozen=True)
class EvaluationReport:
    """The results of policies over the same episodes."""

    policies: Mapping[str, PolicyReport]  # name → results, in the given order
    repeats: int  # number of independent runs
    episodes: int  # number of episodes of each run
    seeds: tuple[int, ...]  # seed of each run
    manifest: Mapping[str, Any]  # closed manifest of the results
    # rows of `rows_by_map` by policy; empty for one map
    by_map: Mapping[str, Sequence[Mapping[str, Any]]]
    # rows of `summary_of` by policy; empty if the caller's process ran the worlds
    resources: Mapping[str, Sequence[Mapping[str, Any]]]

    def __getitem__(self, policy: str) -> PolicyReport:
        return self.policies[policy]

    def to_dict(self) -> dict[str, Any]:
        document = {**asdict(self), "seeds": list(self.seeds)}
        document["metrics"] = {
            metric.name: {
                "unit": "" if metric.share else metric.unit,
                "per": metric.per,
                "meaning": metric.meaning,
            }
            for metric in METRICS
        }
        if self.repeats < 2:
            document["between_run_ci95"] = NO_INTERVAL
        return document


def make_report(
    tables: Mapping[str, tuple[NDArray[np.void], NDArray[np.void]]],
    speeds: Mapping[str, tuple[Speed, ...]],
    manifest: Mapping[str, Any],
    transfers: Mapping[str, TransferSummary],
    resources: Mapping[str, Sequence[Mapping[str, Any]]],
) -> EvaluationReport:
    """Return the report of raw tables: TRIP and EPISODE records of all runs, by policy.

    `speeds` has the speed of each run; `transfers` is empty for undivided worlds, `resources` for
    worlds of the caller's process.
    """
    seeds = tuple(manifest["seeds"])
    found = {
        name: {metric.name: _find(metric, trips, episodes, len(seeds)) for metric in METRICS}
        for name, (trips, episodes) in tables.items()
    }
    first = next(iter(found))
    policies = {
        name: PolicyReport(
            trips=int(tables[name][0]["counted"].sum()),
            metrics=metrics,
            minus_first={}
            if name == first
            else {key: _difference(metrics[key], found[first][key]) for key in metrics},
            speed=speeds[name],
            transfers=transfers.get(name),
        )
        for name, metrics in found.items()
    }
    by_map = rows_by_map(tables, manifest["world"]["maps"])
    episodes = manifest["episodes"]
    return EvaluationReport(policies, len(seeds), episodes, seeds, manifest, by_map, resources)


def _find(metric: Metric, trips: NDArray[np.void], episodes: NDArray[np.void], runs: int) -> Found:
    within = tuple(
        within_run(
            metric_values(metric, trips[trips["run"] == r], episodes[episodes["run"] == r]),
            share=metric.share,
        )
        for r in range(runs)
    )
    means = np.array([run.mean for run in within if run.mean is not None])
    if not means.size:
        return Found(None, None, within)
    if metric.share:
        interval = run_share_interval(means, sum(run.n for run in within))
    elif metric.bounded:
        interval = bounded_interval(means, least_value(metric, trips))
    else:
        interval = mean_interval(means)
    return Found(float(means.mean()), interval, within)


def _difference(mine: Found, first: Found) -> PairedDifference:
    runs = tuple(
        None if a.mean is None or b.mean is None else a.mean - b.mean
        for a, b in zip(mine.within_run, first.within_run, strict=True)
    )
    known = np.array([run for run in runs if run is not None])
    if not known.size:
        return PairedDifference(None, None, runs)
    return PairedDifference(float(known.mean()), mean_interval(known), runs)
