"""`StopBook`: stops that SUMO's vehicles are to make, written into the table while worlds run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.demand.demand_records import STOP, UNTIL_ABSOLUTE

MAX_STOPS = 2_000_000  # of all worlds; memory that is never written is never taken
OF_WORLD = 200_000

Told = tuple[int, float, float, float, float, bool]
"""What SUMO says of a stop: LANE row, start and end in m on SUMO's lane, duration and until in s
or -1, whether the road stays free."""


class StopRange(NamedTuple):
    """STOP rows [first, end) of a vehicle; -1, -1: it makes none."""

    first: int
    end: int


NO_STOPS = StopRange(-1, -1)


class StopBook:
    """The stops of W worlds; equal lists of a world stand there once.

    `table`: STOP, of all worlds.
    """

    def __init__(self, network: RoadNetwork, table: NDArray[np.void], num_worlds: int) -> None:
        lanes = network.lanes
        # SUMO's lanes have a length of their own, which need not be that of their polyline.
        self._scale = lanes["length_m"] / network.edges["length_m"][lanes["edge"]]
        self._table = table
        self._of_world = len(table) // num_worlds
        self._ends = [w * self._of_world for w in range(num_worlds)]
        self._known: list[dict[tuple[Told, ...], StopRange]] = [{} for _ in range(num_worlds)]

    @staticmethod
    def room(num_worlds: int) -> int:
        return min(num_worlds * OF_WORLD, MAX_STOPS)

    def begin(self, w: int) -> None:
        self._ends[w] = w * self._of_world
        self._known[w] = {}

    def enter(self, w: int, stops: Sequence[Sequence[float]]) -> StopRange:
        """Where in the table the stops of a vehicle are, written if they are new.

        `stops`: `Told` of each, in the order in which it reaches them.

        Raises:
            CapacityError: there is no room for more.
        """
        if not stops:
            return NO_STOPS
        told = tuple(_checked(stop) for stop in stops)
        found = self._known[w].get(told)
        if found is None:
            found = self._known[w][told] = self._write(w, told)
        return found

    def _write(self, w: int, told: tuple[Told, ...]) -> StopRange:
        first = self._ends[w]
        end = first + len(told)
        if end > (w + 1) * self._of_world:
            raise CapacityError(
                f"SUMO's vehicles make over {self._of_world} stops in one world: fewer worlds, or "
                "a shorter horizon_s"
            )
        rows = np.zeros(len(told), dtype=STOP)
        for row, (lane, start, stop_end, duration_s, until_s, parking) in zip(
            rows, told, strict=True
        ):
            row["lane"], row["at_edge"] = lane, -1
            row["start"], row["end"] = start * self._scale[lane], stop_end * self._scale[lane]
            row["duration"], row["until"] = max(duration_s, 0.0), until_s
            row["until_from"], row["parking"] = UNTIL_ABSOLUTE, parking
        self._table[first:end] = rows
        self._ends[w] = end
        return StopRange(first, end)

    def shift(self, rows: NDArray[np.void], worlds: int) -> None:
        """Let rows, VEHICLE or departures, mean the stops of so many worlds later."""
        has_some = rows["stop"] >= 0
        for name in ("stop", "stops_end"):
            rows[name] += has_some * (worlds * self._of_world)


def _checked(stop: Sequence[float]) -> Told:
    lane, start, end, duration_s, until_s, parking = stop
    return int(lane), start, end, duration_s, until_s, bool(parking)
