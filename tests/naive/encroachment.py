"""Post-encroachment times of vehicles that cross a junction at constant speeds, in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

from cavmarl.roads.network import RoadNetwork


class Passage(NamedTuple):
    """The passage of a vehicle over a junction."""

    link: int
    start_m: (
        float  # position of the centre at time 0, measured from the stop line; negative before it
    )
    speed_mps: float
    length_m: float


def least_encroachments(network: RoadNetwork, passages: Sequence[Passage]) -> list[float]:
    """Return, for each vehicle, the least post-encroachment time with any other vehicle, or inf.

    Only vehicles whose paths cross count, not vehicles whose paths lead into the same lane.
    """
    least = [float("inf")] * len(passages)
    for a, b in combinations(range(len(passages)), 2):
        mine, other = passages[a], passages[b]
        row = network.links[mine.link]
        first, count = int(row["first_conflict"]), int(row["num_conflicts"])
        for conflict in network.conflicts[first : first + count]:
            if conflict["foe"] != other.link:
                continue
            if network.links[other.link]["to_lane"] == row["to_lane"]:
                continue
            enter, leave = _stay(mine, conflict["enter_m"], conflict["leave_m"])
            foe_enter, foe_leave = _stay(other, conflict["foe_enter_m"], conflict["foe_leave_m"])
            passed = max(foe_enter - leave, enter - foe_leave, 0.0)
            least[a], least[b] = min(least[a], passed), min(least[b], passed)
    return least


def _stay(passage: Passage, enter_m: float, leave_m: float) -> tuple[float, float]:
    """Return the times at which the vehicle enters and leaves a stretch of its link."""
    half = 0.5 * passage.length_m
    return (
        (float(enter_m) - half - passage.start_m) / passage.speed_mps,
        (float(leave_m) + half - passage.start_m) / passage.speed_mps,
    )
