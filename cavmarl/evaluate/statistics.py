"""What trips and episodes add up to: means with intervals, and the record of trips under way."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.config import TERMS
from cavmarl.kernels.terms import TTC_HORIZON_S

__all__ = ["Interval", "TripRecorder", "Trips", "mean_interval", "share_interval"]

Z_95 = 1.959963984540054
RESAMPLES = 2000

_TERM = {name: k for k, name in enumerate(TERMS)}


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % confidence interval; all None without data."""

    mean: float | None
    low: float | None
    high: float | None


def mean_interval(values: NDArray[np.float64]) -> Interval:
    """Mean of `values` (N,), interval by the percentile bootstrap, seeded (Efron 1979)."""
    if not values.size:
        return Interval(None, None, None)
    mean = float(values.mean())
    if values.size == 1:
        return Interval(mean, None, None)
    draws = np.random.Generator(np.random.Philox(0)).integers(
        0, values.size, (RESAMPLES, values.size)
    )
    low, high = np.quantile(values[draws].mean(axis=1), (0.025, 0.975)).tolist()
    return Interval(mean, low, high)


def share_interval(hits: int, total: int) -> Interval:
    """Share of `hits` in `total`, interval by Wilson's score (1927)."""
    if total == 0:
        return Interval(None, None, None)
    share = hits / total
    weight = Z_95 * Z_95 / total
    centre = (share + weight / 2.0) / (1.0 + weight)
    half = math.sqrt(weight * (share * (1.0 - share) + weight / 4.0)) / (1.0 + weight)
    return Interval(share, max(centre - half, 0.0), min(centre + half, 1.0))


@dataclass(frozen=True)
class Trips:
    """N finished or cut trips of agents, one entry each.

    Attributes:
        arrived, collided, off_road: how the trip ended; none of them: the horizon cut it.
        red_light, wrong_way: whether it ever passed a red light, or drove against its lane.
        duration_s: from its first decision to its end.
        distance_m: way made towards the goal.
        delay_s: time lost against driving at the limit.
        mean_jerk_mps3: mean |jerk|.
        mean_speeding: mean speed above the limit, as a share of it.
        least_ttc_s: least time to collision; TTC_HORIZON_S stands for that and above.
    """

    arrived: NDArray[np.bool_]
    collided: NDArray[np.bool_]
    off_road: NDArray[np.bool_]
    red_light: NDArray[np.bool_]
    wrong_way: NDArray[np.bool_]
    duration_s: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    mean_jerk_mps3: NDArray[np.float64]
    mean_speeding: NDArray[np.float64]
    least_ttc_s: NDArray[np.float64]

    @property
    def count(self) -> int:
        """N."""
        return self.arrived.size


class TripRecorder:
    """Follows the trips of W worlds with A agents through one episode each.

    A trip counts if it began in the first half of its episode: so each had at least half an episode
    to end, and which trips count does not depend on how they end.

    Args:
        num_worlds: W.
        num_agents: A.
        max_steps: steps of an episode.
        step_s: seconds a step.
    """

    def __init__(self, num_worlds: int, num_agents: int, max_steps: int, step_s: float) -> None:
        shape = (num_worlds, num_agents)
        self._half = max_steps / 2.0
        self._step_s = step_s
        self._sums = np.zeros((*shape, len(TERMS)))
        self._worst_ttc = np.zeros(shape)
        self._steps = np.zeros(shape, dtype=np.int64)
        self._began = np.zeros(shape, dtype=np.int64)
        self._rows: list[NDArray[np.float64]] = []

    def add(
        self,
        step: int,
        acted: NDArray[np.bool_],
        terms: NDArray[np.float32],
        done: NDArray[np.bool_],
        over: NDArray[np.bool_],
    ) -> None:
        """Take in one step.

        Args:
            step: its number in the episode, from 0.
            acted: (W, A) whose trip this step belongs to.
            terms: (W, A, T).
            done: (W, A) whose trip ended in it.
            over: (W,) whose episode ended in it, which cuts the trips still under way.
        """
        self._began[acted & (self._steps == 0)] = step
        self._steps += acted
        self._sums += np.where(acted[..., None], terms, 0.0)
        ttc = np.where(acted, terms[..., _TERM["time_to_collision"]], 0.0)
        np.maximum(self._worst_ttc, ttc, out=self._worst_ttc)
        ended = (self._steps > 0) & (done | over[:, None])
        counted = ended & (self._began < self._half)
        columns = (self._sums[counted], self._steps[counted, None], self._worst_ttc[counted, None])
        self._rows.append(np.concatenate(columns, axis=1))
        self._sums[ended] = 0.0
        self._steps[ended] = 0
        self._worst_ttc[ended] = 0.0

    def trips(self) -> Trips:
        """All trips that count and have ended."""
        rows = np.concatenate(self._rows) if self._rows else np.zeros((0, len(TERMS) + 2))
        steps, worst_ttc = rows[:, -2], rows[:, -1]
        return Trips(
            arrived=rows[:, _TERM["arrival"]] > 0.0,
            collided=rows[:, _TERM["collision"]] > 0.0,
            off_road=rows[:, _TERM["off_road"]] > 0.0,
            red_light=rows[:, _TERM["red_light"]] > 0.0,
            wrong_way=rows[:, _TERM["wrong_way"]] > 0.0,
            duration_s=steps * self._step_s,
            distance_m=rows[:, _TERM["progress"]],
            delay_s=rows[:, _TERM["delay"]],
            mean_jerk_mps3=10.0 * rows[:, _TERM["comfort"]] / np.maximum(steps, 1.0),
            mean_speeding=rows[:, _TERM["speed"]] / np.maximum(steps, 1.0),
            least_ttc_s=TTC_HORIZON_S * (1.0 - worst_ttc),
        )
