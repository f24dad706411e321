"""`BorderHolds`: vehicles that drive to a border, and those that have to stop before it.

Only worlds with `zones.policy` hold or reroute have one; see docs/ownership.md.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from cavmarl.core.numba.specialized import specialized
from cavmarl.handoff.coordinator.coordinator import Near
from cavmarl.handoff.division import Division
from cavmarl.shards.shard import Shard
from cavmarl.zones.kernels.border_ahead import AHEAD, find_ahead


class Ahead(NamedTuple):
    """A vehicle before a border of its zone; see `kernels.border_ahead.AHEAD`."""

    vehicle: int
    source: int
    row: int
    target: int
    gap_m: float
    depth_m: float
    can_stop: bool

    def near(self) -> Near:
        """The same as what another zone has to be told of."""
        return Near(self.vehicle, self.source, self.row, self.target, False, self.depth_m)


class BorderHolds:
    """The vehicles before borders of all zones, world by world."""

    def __init__(
        self,
        shards: Sequence[Shard],  # one a zone
        division: Division,  # of them
        grace: int,  # ticks that a vehicle drives on for without an acknowledgement
    ) -> None:
        first = shards[0]
        self._first = first
        self._division = division
        self._patience_s = (grace + 1) * first.config.clock.sim_dt_s
        self._found = np.zeros(first.worlds.rows.shape[1], dtype=AHEAD)
        self._find = specialized(find_ahead)

    def ahead(self, w: int) -> list[Ahead]:
        """Vehicles of a world before a border, by its committed rows."""
        division = self._division
        number = self._find(
            division.zones, division.borders.hysteresis_m, self._first.roads, self._first.travel,
            division.zoned, division.side, w, self._patience_s, 0.0, self._found,
        )  # fmt: skip
        return [Ahead(*entry) for entry in self._found[:number].tolist()]

    def hold(self, w: int, ahead: Sequence[Ahead], vehicles: Collection[int]) -> None:
        """Let these vehicles stop before the border in the tick on its way, and no others."""
        rows, counts = self._first.held
        counts[:, w] = 0
        for entry in ahead:
            if entry.vehicle in vehicles:
                zone = entry.source
                rows[zone, w, counts[zone, w]] = entry.vehicle, entry.gap_m
                counts[zone, w] += 1
