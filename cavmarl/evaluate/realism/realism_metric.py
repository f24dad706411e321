"""The realism meta-metric of the Waymo Open Sim Agents Challenge, with the settings of 2024.

For each component, the values of all rollouts and times of an object make a histogram. The
component is the exponential of the mean log-likelihood of the logged values, and the meta-metric is
the weighted sum. The settings are those of the file challenge_2024_config of waymo-open-dataset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ScenarioError
from cavmarl.evaluate.realism.rollout_features import RolloutFeatures, derivative_valid

Numbers = NDArray[np.float64]

YEAR = 2024
ROLLOUTS = 32
_SMOOTHING = 0.1  # added to each bin
_EVENT_SMOOTHING = 0.001  # added to the counts of rollouts with and without the event


class MetricComponent(NamedTuple):
    """A component of the meta-metric, with range and bins of its histogram; 0 bins: an event."""

    weight: float
    bucket: str
    low: float = 0.0
    high: float = 0.0
    bins: int = 0


COMPONENTS: Mapping[str, MetricComponent] = {
    "linear_speed": MetricComponent(0.05, "kinematic", 0.0, 25.0, 10),
    "linear_acceleration": MetricComponent(0.05, "kinematic", -12.0, 12.0, 11),
    "angular_speed": MetricComponent(0.05, "kinematic", -0.628, 0.628, 11),
    "angular_acceleration": MetricComponent(0.05, "kinematic", -3.14, 3.14, 11),
    "distance_to_nearest_object": MetricComponent(0.1, "interactive", -5.0, 40.0, 10),
    "collision_indication": MetricComponent(0.25, "interactive"),
    "time_to_collision": MetricComponent(0.1, "interactive", 0.0, 5.0, 10),
    "distance_to_road_edge": MetricComponent(0.1, "map_based", -20.0, 40.0, 10),
    "offroad_indication": MetricComponent(0.25, "map_based"),
}
BUCKETS = tuple(dict.fromkeys(one.bucket for one in COMPONENTS.values()))


@dataclass(frozen=True)
class Realism:
    """The realism of rollouts of one scene, all in [0, 1]."""

    likelihoods: Mapping[str, float]  # component → likelihood

    @property
    def meta(self) -> float:
        """The meta-metric."""
        return sum(COMPONENTS[name].weight * value for name, value in self.likelihoods.items())

    @property
    def buckets(self) -> dict[str, float]:
        """Weighted means of the kinematic, interactive and map-based components."""
        found = {}
        for bucket in BUCKETS:
            names = [name for name, one in COMPONENTS.items() if one.bucket == bucket]
            weights = [COMPONENTS[name].weight for name in names]
            values = [self.likelihoods[name] for name in names]
            total = sum(weight * value for weight, value in zip(weights, values, strict=True))
            found[bucket] = total / sum(weights)
        return found

    def to_dict(self) -> dict[str, float]:
        """Return all values by name."""
        return {"meta_metric": self.meta, **self.buckets, **self.likelihoods}


def realism_of(log: RolloutFeatures, rollouts: Sequence[RolloutFeatures], first: int) -> Realism:
    """Return the realism of rollouts.

    `first`: the first time that is compared; earlier times only serve derivatives. The values of a
    rollout count where its object is present and, for derivatives, also present before and after.

    Raises ScenarioError: the log has no value of a component.
    """
    speed, acceleration = _derivatives_valid(log.valid)
    found = {}
    for name, component in COMPONENTS.items():
        if not component.bins:
            found[name] = _event_likelihood(name, log, rollouts, first)
            continue
        valid = {"linear_speed": speed, "angular_speed": speed}.get(name, log.valid)
        valid = acceleration if name.endswith("acceleration") else valid
        values = getattr(log, name)[:, first:]
        samples = []
        for one in rollouts:
            own_speed, own_acceleration = _derivatives_valid(one.valid)
            there = one.valid
            if name.endswith("speed"):
                there = own_speed
            elif name.endswith("acceleration"):
                there = own_acceleration
            samples.append(np.where(there, getattr(one, name), np.nan)[:, first:])
        likelihoods = _log_likelihoods(component, values, np.stack(samples, axis=1))
        found[name] = _mean_likelihood(name, likelihoods, valid[:, first:])
    return Realism(found)


def _derivatives_valid(valid: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    speed = derivative_valid(valid)
    return speed, derivative_valid(speed)


def _log_likelihoods(component: MetricComponent, values: Numbers, samples: Numbers) -> Numbers:
    """Return (E, T) log-likelihoods of values (E, T), by samples (E, R, T) of R rollouts."""
    low, high, bins = component.low, component.high, component.bins
    edges = np.linspace(low, high, bins + 1)
    found = np.full(values.shape, np.nan)
    for k, (own, drawn) in enumerate(zip(values, samples, strict=True)):
        drawn = drawn[np.isfinite(drawn)]
        counts = np.bincount(_bins(drawn, edges), minlength=bins) + _SMOOTHING
        known = np.isfinite(own)
        found[k, known] = np.log(counts / counts.sum())[_bins(own[known], edges)]
    return found


def _bins(values: Numbers, edges: Numbers) -> NDArray[np.int64]:
    """Return the bin of each value; values beyond the ends are in the first or last bin."""
    found = np.searchsorted(edges, values, side="right") - 1
    return np.clip(found, 0, len(edges) - 2).astype(np.int64)


def _mean_likelihood(name: str, likelihoods: Numbers, valid: NDArray[np.bool_]) -> float:
    chosen = likelihoods[valid & np.isfinite(likelihoods)]
    if not chosen.size:
        raise ScenarioError(
            f"{name}: the log has no value to compare with; the driven vehicles need at least five "
            "consecutive samples from scenario.params.start_s on"
        )
    return float(np.exp(chosen.mean()))


def _event_likelihood(
    name: str, log: RolloutFeatures, rollouts: Sequence[RolloutFeatures], first: int
) -> float:
    """Return the geometric mean likelihood of the log: which objects have the event or lack it.

    The likelihood of an object is the share of the rollouts that agree with the log about it.
    """
    kind = "collided" if name == "collision_indication" else "off_road"
    seen = log.valid[:, first:]
    happened = (getattr(log, kind)[:, first:] & seen).any(axis=1)
    drawn = np.stack(
        [(getattr(one, kind)[:, first:] & one.valid[:, first:] & seen).any(axis=1)
         for one in rollouts]
    )  # fmt: skip
    share = np.where(happened, drawn.sum(axis=0), (~drawn).sum(axis=0)) + _EVENT_SMOOTHING
    return float(np.exp(np.log(share / (len(drawn) + 2.0 * _EVENT_SMOOTHING)).mean()))
