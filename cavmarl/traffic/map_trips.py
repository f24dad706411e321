"""`MapTrips`: the trips that the generator may draw on one map of a network."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.traffic import TrafficConfig
from cavmarl.core.errors import CavmarlError, ConfigError, RouteError
from cavmarl.core.records.arrays import TripTable
from cavmarl.roads.network import CARS, RoadNetwork

MIN_ORIGIN_M = 15.0  # m; trips do not start on shorter lanes
MIN_GOAL_M = 10.0  # m; trips do not end on edges whose lanes are all shorter
DENSITY_M = 25.0  # m; in the draw at reset, a lane counts once for each such length
MAX_TRIPS = 200_000  # maximum number per table; longer tables are thinned evenly

ANY_LENGTH_M = (0.0, math.inf)

T = TypeVar("T")


def for_each_map(network: RoadNetwork, make: Callable[[int], T]) -> list[T]:
    """Return `make(row)` for each MAP row.

    Raises:
        CavmarlError: `make` failed; the error has the class of the first error and all messages.
    """
    found: list[T] = []
    refused: list[CavmarlError] = []
    for number in range(len(network.maps)):
        try:
            found.append(make(number))
        except CavmarlError as error:
            refused.append(error)
    if refused:
        raise type(refused[0])("\n".join(map(str, refused))) from refused[0]
    return found


def together(parts: Sequence[NDArray[np.int32]]) -> TripTable:
    """Join the trips of all maps, (P, 2) each, into one table."""
    first = np.cumsum([0, *map(len, parts)], dtype=np.int64)
    return TripTable(np.ascontiguousarray(np.concatenate(parts)), first)


class DrawnTrips(NamedTuple):
    """Trips of one map, each (P, 2): LANE row of the origin, and goal."""

    agent_arrays: NDArray[np.int32]
    at_start: NDArray[np.int32]  # trips of background vehicles at reset
    entering: NDArray[np.int32]  # trips of vehicles that enter later
    has_ways_in: bool  # whether `entering` starts on roads that lead into the map


@dataclass(frozen=True)
class MapTrips:
    """Trips of one map."""

    network: RoadNetwork
    number: int  # MAP row
    traffic: TrafficConfig

    @cached_property
    def metres(self) -> float:
        """Total length in m of the lanes for cars outside junctions."""
        return float(self.network.lanes["length_m"][self._usable].sum())

    def goals(self, acted: Sequence[int]) -> list[int]:
        """Return the EDGE rows of goals: named destinations, then edges spread over the map.

        `acted`: further goals, used by a scenario.
        """
        named = [self._edge(name, "destinations") for name in self.traffic.destinations]
        edges = self._drivable_edges(MIN_GOAL_M)
        leaves = [e for e in edges if self._is_way_out(e)]
        rest = [e for e in edges if e not in set(leaves)]
        # Roads out of the map come first. Other edges are picked evenly by row, not at random.
        candidates = leaves + rest
        named += acted
        wanted = max(self.traffic.goals, len(named))
        if len(leaves) < wanted and rest:
            picks = np.linspace(0, len(rest) - 1, min(wanted - len(leaves), len(rest)))
            candidates = leaves + [rest[round(p)] for p in picks]
        return list(dict.fromkeys(named + candidates))[:wanted]

    def drawn(self, plans: NDArray[np.void], num_goals: int) -> DrawnTrips:
        """Return the trips from which departures are drawn.

        `plans`: PLAN (G, L). `num_goals`: G.

        Raises ConfigError: no trip on this map has a length within the configured limits.
        """
        lanes = self.network.lanes
        edges = set(self._drivable_edges(MIN_ORIGIN_M))
        named = [self._edge(name, "origins") for name in self.traffic.origins]
        start = self._lanes_of(named or sorted(edges))
        entries = self._lanes_of(sorted(e for e in edges if self._is_way_in(e)))
        anywhere = self._lanes_of(sorted(edges))
        copies = np.ceil(lanes["length_m"][anywhere] / DENSITY_M).astype(np.int64)
        goals = np.arange(num_goals)
        targets = goals[: len(self.traffic.destinations)] if self.traffic.destinations else goals
        limits_m = self.traffic.min_trip_m, self.traffic.max_trip_m or math.inf
        has_ways_in = self._fitting(plans, entries, goals, ANY_LENGTH_M).size > 0
        enter = entries if has_ways_in else anywhere
        return DrawnTrips(
            at_start=self._trips(plans, np.repeat(anywhere, copies), goals, ANY_LENGTH_M),
            agent_arrays=self._trips(plans, start, targets, limits_m),
            entering=self._trips(plans, enter, goals, ANY_LENGTH_M),
            has_ways_in=has_ways_in,
        )

    @cached_property
    def _usable(self) -> NDArray[np.bool_]:
        """(L,) whether a lane belongs to this map, admits cars, and is outside junctions."""
        lanes = self.network.lanes
        usable: NDArray[np.bool_] = (
            (lanes["map"] == self.number) & ~lanes["internal"] & (lanes["permissions"] & CARS != 0)
        )
        return usable

    def _edge(self, name: str, key: str) -> int:
        try:
            return self.network.edge_ids.index(name)
        except ValueError:
            some = [n for n in self.network.edge_ids if not n.startswith(":")][:8]
            raise ConfigError(
                f"traffic.{key}: the map '{self.network.name}' has no edge '{name}'; "
                f"it has {', '.join(some)} …"
            ) from None

    def _drivable_edges(self, least_m: float) -> list[int]:
        """Return EDGE rows outside junctions that have a car lane at least `least_m` long."""
        lanes = self.network.lanes
        good = self._usable & (lanes["length_m"] >= least_m)
        found = [int(edge) for edge in np.unique(lanes["edge"][good])]
        if not found:
            name = self.network.name_of(self.number)
            raise RouteError(f"map '{name}': no edge for cars is {least_m:g} m long or more")
        return found

    def _lanes_of(self, edges: list[int]) -> NDArray[np.int64]:
        lanes = self.network.lanes
        on_edge = np.isin(lanes["edge"], edges) & (lanes["permissions"] & CARS != 0)
        return np.flatnonzero(on_edge & (lanes["length_m"] >= MIN_ORIGIN_M))

    def _is_way_out(self, edge: int) -> bool:
        row = self.network.edges[edge]
        lanes = self.network.lanes[row["first_lane"] : row["first_lane"] + row["num_lanes"]]
        return not bool(lanes["num_links"].any())

    def _is_way_in(self, edge: int) -> bool:
        row = self.network.edges[edge]
        lanes = self.network.lanes[row["first_lane"] : row["first_lane"] + row["num_lanes"]]
        return not bool(lanes["num_into"].any())

    def _trips(
        self,
        plans: NDArray[np.void],
        origins: NDArray[np.int64],
        goals: NDArray[np.int64],
        limits_m: tuple[float, float],
    ) -> NDArray[np.int32]:
        """Return `_fitting`, thinned to at most `MAX_TRIPS` trips.

        Raises ConfigError: no trip fits.
        """
        trips = self._fitting(plans, origins, goals, limits_m)
        if not len(trips):
            raise self._no_trip(plans["to_go"][np.ix_(goals, origins)], limits_m)
        if len(trips) > MAX_TRIPS:
            trips = trips[:: -(-len(trips) // MAX_TRIPS)]
        return np.ascontiguousarray(trips)

    def _no_trip(self, to_go: NDArray[np.float64], limits_m: tuple[float, float]) -> ConfigError:
        """Return the error that explains why routes of lengths `to_go` (m or inf) allow no trip."""
        name = self.network.name_of(self.number)
        if _is_within(to_go, limits_m).any():
            return ConfigError(
                f"no trip on the map '{name}': every route between origins and "
                "destinations begins with a lane change, or has a turn that is too tight for a "
                "car; change traffic.origins or traffic.destinations, or mend the map"
            )
        reachable = to_go[np.isfinite(to_go)]
        longest = "no route leads to a goal"
        if reachable.size:
            longest = f"the longest route is {reachable.max():.0f} m"
        return ConfigError(
            f"traffic.min_trip_m = {self.traffic.min_trip_m:g}, traffic.max_trip_m = "
            f"{self.traffic.max_trip_m:g}: no trip of that length on the map '{name}' ({longest}); "
            "change the limits, traffic.origins or traffic.destinations"
        )

    def _fitting(
        self,
        plans: NDArray[np.void],
        origins: NDArray[np.int64],
        goals: NDArray[np.int64],
        limits_m: tuple[float, float],
    ) -> NDArray[np.int32]:
        """Return (P, 2) pairs of origin lane and goal with a route of a length within `limits_m`.

        No trip begins with a lane change, and no trip has a turn that is too tight for the turning
        circle of a car.
        """
        pairs = np.ix_(goals, origins)
        fits = _is_within(plans["to_go"][pairs], limits_m)
        fits &= (plans["change"][pairs] == 0) & (plans["turnarounds"][pairs] == 0)
        goal, origin = np.nonzero(fits)
        return np.stack([origins[origin], goals[goal]], axis=1).astype(np.int32)


def _is_within(way_m: NDArray[np.float64], limits_m: tuple[float, float]) -> NDArray[np.bool_]:
    least_m, most_m = limits_m
    return np.isfinite(way_m) & (way_m >= least_m) & (way_m <= most_m)
