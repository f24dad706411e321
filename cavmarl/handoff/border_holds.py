"""`BorderHolds`: vehicles that drive to a border, and those that have to stop or turn away.

Only worlds with `zones.policy` hold or reroute have one; see docs/ownership.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cavmarl.core.compiled import specialized
from cavmarl.handoff.coordinator.coordinator import Near
from cavmarl.handoff.division import Division
from cavmarl.ownership.messages import BorderWait
from cavmarl.shards.shard import Shard
from cavmarl.traffic.found_ways import Closed, FoundWays
from cavmarl.zones.kernels.border_ahead import AHEAD, close_edges, find_ahead

TURN_M = 100.0  # so much earlier than it has to brake a vehicle may turn away


class Ahead(NamedTuple):
    """A vehicle before a border of its zone; see `kernels.border_ahead.AHEAD`."""

    vehicle: int
    source: int
    row: int
    target: int
    gap_m: float
    depth_m: float
    can_stop: bool
    has_to_brake: bool

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
        ways: FoundWays | None = None,  # of vehicles that turn away instead; None: they only stop
    ) -> None:
        first = shards[0]
        self._first = first
        self._division = division
        dt = first.config.clock.sim_dt_s
        self._patience_s = (grace + 1) * dt
        self._grace = grace
        self._ticks_per_s = max(1, round(1.0 / dt))
        self._ways = ways
        self._more_m = 0.0 if ways is None else TURN_M
        self._closed: dict[int, Closed] = {}  # by zone
        self._found = np.zeros(first.worlds.rows.shape[1], dtype=AHEAD)
        self._find = specialized(find_ahead)

    def ahead(self, w: int) -> list[Ahead]:
        """Vehicles of a world before a border, by its committed rows."""
        division = self._division
        number = self._find(
            division.zones, division.borders.hysteresis_m, self._first.roads, self._first.travel,
            division.zoned, division.side, w, self._patience_s, self._more_m, self._found,
        )  # fmt: skip
        return [Ahead(*entry) for entry in self._found[:number].tolist()]

    def hold(self, w: int, ahead: Sequence[Ahead], held: Sequence[BorderWait]) -> None:
        """Keep these vehicles from the border in the tick on its way, and no others."""
        rows, counts = self._first.held
        counts[:, w] = 0
        ticks = {wait.vehicle: wait.ticks for wait in held}
        kept = [entry for entry in ahead if entry.vehicle in ticks]
        for entry in kept:
            if entry.has_to_brake:
                zone = entry.source
                rows[zone, w, counts[zone, w]] = entry.vehicle, entry.gap_m
                counts[zone, w] += 1
        if self._ways is not None:
            self._ways.turned_away.pop(w, None)
            turned = {
                entry.vehicle: self._edges_of(entry.target)
                for entry in kept
                if (ticks[entry.vehicle] - self._grace - 1) % self._ticks_per_s == 0
            }
            if turned:
                self._ways.turned_away[w] = turned

    def _edges_of(self, zone: int) -> Closed:
        if zone not in self._closed:
            closed = np.zeros(len(self._first.roads.edges), dtype=np.int64)
            close_edges(self._division.zones, self._first.roads, zone, closed)
            self._closed[zone] = closed
        return self._closed[zone]
