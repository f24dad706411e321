"""Comparison of reward terms near zone borders and inside zones, to reveal effects of borders."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.zones.partition.zone_partition import ZonePartition

NEAR_M = 25.0  # distance to another zone below which a vehicle is near a border
PLACES = ("inside", "near border")
PER_HOUR = ("collision", "off_road", "red_light", "wrong_way", "arrival")  # per hour of driving
PER_STEP = ("jerk", "ttc_risk", "speeding", "delay", "energy", "co2")  # averaged over steps


class BorderTerms:
    """Sums over the steps of agents, by zone and by distance to a border.

    Attributes:
        step_s: length of a step in s.
        steps: (Z, 2) number of agent steps, inside and near a border.
        sums: (Z, 2, T) sum of each term over these steps.
    """

    def __init__(self, partition: ZonePartition, step_s: float) -> None:
        self._partition = partition
        self.step_s = step_s
        self.steps = np.zeros((partition.count, len(PLACES)), dtype=np.int64)
        self.sums = np.zeros((partition.count, len(PLACES), len(TERMS)))

    def add(
        self,
        places_m: NDArray[np.float64],
        acted: NDArray[np.bool_],
        terms: NDArray[np.float32],
    ) -> None:
        """Add a step.

        Args:
            places_m: (W, A, 2) positions of the agents before the step.
            acted: (W, A) which agents count.
            terms: (W, A, T) terms of the step; registered terms are last, and not summed.
        """
        if self._partition.count == 1 or not acted.any():
            return
        xy = places_m[acted]
        known = np.isfinite(xy).all(axis=1)
        xy, found = xy[known], terms[acted][known][:, : len(TERMS)]
        zones = self._partition.zones_of(xy)
        rects = self._partition.reaching[zones]
        gap_m = np.minimum(xy - rects[:, :2], rects[:, 2:] - xy).min(axis=1)
        near = (gap_m < NEAR_M).astype(np.int64)
        np.add.at(self.steps, (zones, near), 1)
        np.add.at(self.sums, (zones, near), found)


def place_rows(parts: Iterable[BorderTerms]) -> list[dict[str, Any]]:
    """Return the table of a policy: all zones together (-1), and each zone.

    Returns:
        Rows of `zone`, `place`, `agent_hours`, `<term>_per_h` of events and mean `<term>`s; None
        where no agent drove.
    """
    every = list(parts)
    if not every or every[0].steps.shape[0] == 1:
        return []
    steps = sum((part.steps for part in every), np.zeros_like(every[0].steps))
    sums = sum((part.sums for part in every), np.zeros_like(every[0].sums))
    groups = [(-1, steps.sum(axis=0), sums.sum(axis=0))]
    groups += [(zone, steps[zone], sums[zone]) for zone in range(len(steps))]
    rows = []
    for zone, counts, totals in groups:
        for place, count, total in zip(PLACES, counts.tolist(), totals.tolist(), strict=True):
            of = dict(zip(TERMS, total, strict=True))
            hours = count * every[0].step_s / 3600.0
            row: dict[str, Any] = {"zone": zone, "place": place, "agent_hours": hours}
            row |= {f"{term}_per_h": of[term] / hours if count else None for term in PER_HOUR}
            row |= {term: of[term] / count if count else None for term in PER_STEP}
            rows.append(row)
    return rows
