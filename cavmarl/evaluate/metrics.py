"""The metrics of a report. Each is a column of trips or of episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.evaluate.tables import reward_column

Per = Literal["trip", "episode", "run"]
Better = Literal["more", "less"] | None

KM_PER_INFRACTION = "km_per_infraction"
INFRACTIONS = ("collision", "off_road", "red_light", "wrong_way")


@dataclass(frozen=True)
class Metric:
    """A metric."""

    name: str  # key in a report, and name of the column
    label: str  # name in tables
    unit: str  # unit of the values times `scale`; empty for plain numbers
    per: Per  # each trip, each episode or each run has a value
    meaning: str  # one line
    better: Better = None  # whether higher or lower is better; None: neither
    share: bool = False  # values are yes or no, so their mean is a share
    bounded: bool = False  # values are from `least_value` to 1
    arrived: bool = False  # only arrived trips have a value
    scale: float = 1.0  # factor for display

    @property
    def title(self) -> str:
        return f"{self.label}, {self.unit}" if self.unit else self.label


def _share(name: str, label: str, meaning: str, better: Better) -> Metric:
    return Metric(name, label, "%", "trip", meaning, better, share=True, bounded=True, scale=100.0)


def _arrived(name: str, label: str, meaning: str, better: Better = None) -> Metric:
    told = f"{meaning}, of trips that arrived"
    return Metric(name, label, "s", "trip", told, better, arrived=True)


def _percent(name: str, label: str, meaning: str, better: Better) -> Metric:
    return Metric(name, label, "%", "episode", meaning, better, bounded=True, scale=100.0)


METRICS = (
    Metric("episode_return", "return", "", "episode",
           "sum of rewards of an agent id over an episode, mean over the ids", "more"),
    _share("success", "success",
           "trips that arrived in time (within their own horizon or, without one, within three "
           "times the free travel time) and never passed a red light or drove against a lane",
           "more"),
    _share("arrived", "arrived", "trips that arrived", "more"),
    _share("collision", "collision", "trips that ended by touching a vehicle", "less"),
    _share("off_road", "off road", "trips that ended off the road", "less"),
    _share("unfinished", "unfinished", "trips that were cut by the horizon of the episode or trip",
           "less"),
    _share("blocked", "blocked", "trips that were cut while stopped where the built-in driver "
           "would stop, too", "less"),
    _share("stood", "stood", "trips that were cut while stopped where the built-in driver would "
           "drive", "less"),
    _share("out_of_time", "out of time", "trips that were cut while moving", "less"),
    _share("red_light", "red light", "trips that passed a red light", "less"),
    _share("wrong_way", "wrong way", "trips that drove against a lane", "less"),
    Metric(KM_PER_INFRACTION, "way per infraction", "km", "run",
           "kilometres driven per collision, departure from the road, red light or wrong way; "
           "without any, all kilometres (a lower bound)", "more"),
    Metric("agent_arrivals_per_h", "agents arriving", "1/h", "episode",
           "agents that arrived in an hour of simulated time", "more"),
    Metric("background_arrivals_per_h", "others arriving", "1/h", "episode",
           "background vehicles that arrived in an hour of simulated time", "more"),
    _arrived("delay_s", "delay", "time lost compared with driving at the limit or the type's "
             "maximum speed", "less"),
    _arrived("duration_s", "duration", "from the first decision to the goal"),
    Metric("mean_speed_mps", "speed", "m/s", "trip", "progress towards the goal over time"),
    Metric("energy_wh_per_km", "energy", "Wh/km", "run",
           "energy of the agents per kilometre of progress, as if they were electric cars", "less"),
    Metric("co2_g_per_km", "CO₂", "g/km", "run",
           "CO₂ of the agents per kilometre of progress, with combustion engines", "less"),
    Metric("background_energy_wh_per_km", "energy of others", "Wh/km", "episode",
           "energy of background vehicles per kilometre, as if they were electric cars", "less"),
    Metric("background_co2_g_per_km", "CO₂ of others", "g/km", "episode",
           "CO₂ of background vehicles per kilometre, with combustion engines", "less"),
    Metric("mean_speeding", "speeding", "%", "trip",
           "mean speed above the limit, as a share of it", "less", scale=100.0),
    Metric("mean_jerk_mps3", "jerk", "m/s³", "trip", "mean |jerk|", "less"),
    Metric("least_ttc_s", "least TTC", "s", "trip",
           "least time to collision of a trip; 4 means 4 s or more", "more"),
    Metric("short_ttc_share", "TTC < 1.5 s", "% time", "trip",
           "share of a trip with a time to collision below 1.5 s", "less", bounded=True,
           scale=100.0),
    Metric("least_pet_s", "least PET", "s", "trip",
           "least post-encroachment time of a trip that met crossing traffic within 10 s", "more"),
    Metric("jain_speed", "speeds, Jain", "", "episode",
           "Jain's index of the agents' mean speeds: 1 is even", "more", bounded=True),
    Metric("gini_delay", "delays, Gini", "", "episode",
           "Gini's coefficient of the agents' delays per kilometre: 0 is even", "less",
           bounded=True),
    Metric("zone_imbalance", "zone imbalance", "", "episode",
           "vehicles of the fullest zone over the mean of all zones, mean over the steps: 1 is "
           "even", "less"),
    _percent("v2x_reception_ratio", "packets received",
             "share of received packets among the packets within reach of a receiver", "more"),
    Metric("v2x_latency_s", "latency of packets", "s", "episode",
           "mean time from sending to receiving", "less"),
    _percent("v2x_busy_ratio", "channel busy ratio",
             "share of the time in which a receiver finds the channel busy", "less"),
    *(
        Metric(reward_column(term), f"return from {term.replace('_', ' ')}", "", "episode",
               f"part of the return: weight · sum of `{term}`")
        for term in TERMS
    ),
)  # fmt: skip


def metric_values(
    metric: Metric, trips: NDArray[np.void], episodes: NDArray[np.void]
) -> NDArray[np.float64]:
    """Return the values (N,) of a metric, NaN for none; only counted trips are used."""
    if metric.per == "episode":
        return np.asarray(episodes[metric.name], dtype=np.float64)
    rows = trips[trips["counted"]]
    if metric.per == "run":
        return _of_run(metric, rows)
    if metric.arrived:
        rows = rows[rows["arrived"]]
    return np.asarray(rows[metric.name], dtype=np.float64)


def _of_run(metric: Metric, trips: NDArray[np.void]) -> NDArray[np.float64]:
    """Return one value (1,), or none (0,) without trips; a value per km also needs kilometres."""
    km = np.maximum(trips["distance_m"], 0.0).sum(keepdims=True) / 1000.0
    if metric.name == KM_PER_INFRACTION:
        infractions = sum(int(trips[name].sum()) for name in INFRACTIONS)
        return np.asarray(km / max(infractions, 1), dtype=np.float64)[: len(trips)]
    sums = trips[metric.name.removesuffix("_per_km")].sum(keepdims=True)
    return np.asarray(sums[km > 0.0] / km[km > 0.0], dtype=np.float64)


def least_value(metric: Metric, trips: NDArray[np.void]) -> float:
    """Return the least possible value of a bounded metric for an episode with these trips."""
    if metric.name != "jain_speed":
        return 0.0
    counted = trips[trips["counted"]]
    _, sizes = np.unique(counted[["run", "episode"]], return_counts=True)
    return 1.0 / float(sizes.max(initial=1))
