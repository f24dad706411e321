"""`EvaluationReport`: what an evaluation found, as plain frozen values."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.evaluate.manifest import Manifest
from cavmarl.evaluate.statistics import Interval, Trips, mean_interval, share_interval

__all__ = ["EvaluationReport", "Speed", "make_report"]


@dataclass(frozen=True)
class Speed:
    """How fast it ran.

    Attributes:
        step_ms: milliseconds of simulation for one step of one world.
        policy_ms: milliseconds of the policy for one step of one world.
        agent_steps_per_s: decisions a second, simulation and policy.
        worlds: how many were stepped together.
    """

    step_ms: float
    policy_ms: float
    agent_steps_per_s: float
    worlds: int


@dataclass(frozen=True)
class EvaluationReport:
    """A driver's results over seeded episodes.

    Rates are shares of the trips that count: those that began in the first half of an episode.
    `success`, `collision`, `off_road` and `unfinished` add up to 1; `red_light` and `wrong_way` are
    of trips in which that happened at all.

    Attributes:
        episodes: each counted once.
        trips: that count.
        episode_return: sum of rewards of an agent id over an episode, mean over the ids.
        success: arrived.
        collision: ended by touching a vehicle.
        off_road: ended off the road.
        unfinished: cut by the horizon.
        red_light: passed a red light.
        wrong_way: drove against a lane.
        least_ttc_s: least time to collision of all trips, 4 at most.
        mean_least_ttc_s: mean over the trips of each one's least.
        mean_jerk_mps3: mean over the trips of their mean |jerk|.
        mean_speeding: mean over the trips of their mean speed above the limit, as a share of it.
        mean_delay_s: mean over the arrived trips.
        mean_speed_mps: way made towards goals over time on the way, all trips.
        mean_trip_s: mean duration of the arrived trips.
        speed: how fast it ran; not repeatable.
        manifest: what it was made with.
    """

    episodes: int
    trips: int
    episode_return: Interval
    success: Interval
    collision: Interval
    off_road: Interval
    unfinished: Interval
    red_light: Interval
    wrong_way: Interval
    least_ttc_s: float | None
    mean_least_ttc_s: Interval
    mean_jerk_mps3: Interval
    mean_speeding: Interval
    mean_delay_s: Interval
    mean_speed_mps: float | None
    mean_trip_s: Interval
    speed: Speed
    manifest: Manifest

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def make_report(
    trips: Trips, returns: NDArray[np.float64], speed: Speed, manifest: Manifest
) -> EvaluationReport:
    """Reduce trips and episode returns (E,) to a report."""
    total = trips.count
    off_road = trips.off_road & ~trips.collided
    arrived = trips.arrived & ~trips.collided & ~off_road
    cut = ~(arrived | trips.collided | off_road)

    def share(which: NDArray[np.bool_]) -> Interval:
        return share_interval(int(which.sum()), total)

    return EvaluationReport(
        episodes=returns.size,
        trips=total,
        episode_return=mean_interval(returns),
        success=share(arrived),
        collision=share(trips.collided),
        off_road=share(off_road),
        unfinished=share(cut),
        red_light=share(trips.red_light),
        wrong_way=share(trips.wrong_way),
        least_ttc_s=float(trips.least_ttc_s.min()) if total else None,
        mean_least_ttc_s=mean_interval(trips.least_ttc_s),
        mean_jerk_mps3=mean_interval(trips.mean_jerk_mps3),
        mean_speeding=mean_interval(trips.mean_speeding),
        mean_delay_s=mean_interval(trips.delay_s[arrived]),
        mean_speed_mps=float(trips.distance_m.sum() / trips.duration_s.sum()) if total else None,
        mean_trip_s=mean_interval(trips.duration_s[arrived]),
        speed=speed,
        manifest=manifest,
    )
