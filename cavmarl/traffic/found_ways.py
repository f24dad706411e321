"""`FoundWays`: ways that vehicles find while the world runs, and vehicles that have to turn away.

A way lies in a slot behind the table of all ways. `Rerouting` has more vehicles that look for one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import Gate, RoadArrays, Travel, Worlds
from cavmarl.core.records.codes import COUNT_REROUTED, DRIVER_BACKGROUND, EVENT_ARRIVED
from cavmarl.roads.routing import PLAN
from cavmarl.traffic.kernels.way_requests import last_edge, mark_slots
from cavmarl.traffic.schedule import Schedule
from cavmarl.traffic.way_search import Traffic, WaySearch, WaySearchResult, WaySlots

Closed = NDArray[np.int64]
"""(num_edges,) bits of the classes that an edge is closed to."""


class FoundWays:
    """The slots of W worlds, and the vehicles that drive along what lies in them.

    Attributes:
        turned_away: world → vehicle → edges that it is to keep away from, in the tick on its way;
            to be set.
    """

    def __init__(
        self,
        roads: RoadArrays,
        travel: Travel,  # types and ways, with room behind them
        slots: WaySlots,  # that room
        schedule: Schedule | None = None,  # of the demand file, if there is one
    ) -> None:
        self.turned_away: dict[int, Mapping[int, Closed]] = {}
        self._roads = roads
        self._travel = travel
        self._slots = slots
        self._orders = schedule
        # world → order of the demand file → whether it may leave its route
        self._may_leave: dict[int, NDArray[np.bool_]] = {}

    def begin(self, world: int, key: int, horizon_s: float) -> None:
        """Forget an episode of a world and take up the next.

        `key`: of the world and the new episode. `horizon_s`: seconds an episode.
        """
        if self._orders is not None:
            orders = self._orders.orders(key, horizon_s)
            routes = self._orders.demand.routes[orders["route"]]
            # No edge between the first and the last is one that it has to pass.
            self._may_leave[world] = routes["exact"] | (routes["num_edges"] <= 2)
        first = self._slots.first_of(world)
        self._travel.steps[first : first + self._slots.of_world] = np.zeros((), dtype=PLAN)

    def turn_away(self, gate: Gate, worlds: Worlds) -> None:
        """Put vehicles on ways that keep away from closed edges, where there are; `next_rows`."""
        for w, vehicles in sorted(self.turned_away.items()):
            rows, num = worlds.next_rows[w], int(worlds.num_owned[w])
            places = {int(vehicle): i for i, vehicle in enumerate(rows["id"][:num])}
            for vehicle, closed in sorted(vehicles.items()):
                i = places.get(vehicle, -1)
                if i >= 0 and self._may_turn(w, rows[i]):
                    gate.counts[w, COUNT_REROUTED] += self._turn(w, rows, num, i, closed)

    def ways_of_first_world(self, ways: NDArray[np.int64], world: int) -> NDArray[np.int64]:
        """VEHICLE["way"] (n,) of a world as it would be in the first one."""
        return self._slots.ways_of_first_world(ways, world)

    def ways_of_world(self, ways: NDArray[np.int64], world: int) -> NDArray[np.int64]:
        """VEHICLE["way"] (n,) in a world, of ways as they are in the first one."""
        return self._slots.ways_of_first_world(ways, -world)

    def state(self, world: int, rows: NDArray[np.void]) -> Iterator[NDArray[np.generic]]:
        """What of a world's state is kept here, as arrays without padding.

        `rows`: VEHICLE (n,), its vehicles: only the ways that they drive on count.
        """
        slots = self._slots
        used = np.zeros(slots.number, dtype=np.bool_)
        first = slots.first_of(world)
        mark_slots(self._roads, rows, len(rows), first, slots.steps, used)
        steps = self._travel.steps[first : first + slots.of_world]
        yield from plain(steps.reshape(slots.number, slots.steps)[used])

    def arrays(self) -> Iterator[NDArray[np.generic]]:
        """What a tick changes here, of all worlds; to be copied and put back."""
        yield self._travel.steps[self._slots.first :]

    def arrays_of(self, world: int) -> Iterator[NDArray[np.generic]]:
        """`arrays` as they would be if there were no world but one."""
        first = self._slots.first_of(world)
        yield self._travel.steps[first : first + self._slots.of_world]

    def _may_turn(self, w: int, row: np.void) -> bool:
        """Whether a vehicle is one that can look for another way now."""
        if row["driver"] != DRIVER_BACKGROUND or row["events"] & EVENT_ARRIVED:
            return False
        if row["stop"] >= 0 and row["stop"] < row["stops_end"]:
            return False
        if self._roads.lanes[row["lane"]]["internal"]:
            return False
        return row["order"] < 0 or bool(self._may_leave[w][row["order"]])

    def _turn(self, w: int, rows: NDArray[np.void], num: int, i: int, closed: Closed) -> bool:
        """Put row i on the fastest way to its goal that keeps away; whether there is one."""
        row = rows[i]
        goal = last_edge(self._roads, self._travel, row["lane"], row["way"])
        if goal < 0:
            return False
        traffic = Traffic(np.zeros(len(closed), dtype=np.int64), 0, closed)
        search = WaySearch(self._roads, self._travel, self._slots, w, rows, num, traffic)
        if not search.meets_closing(i):
            return False
        return search.send(i, goal, False, True) is WaySearchResult.TAKEN


def plain(records: NDArray[np.void]) -> Iterator[NDArray[np.generic]]:
    """The fields of records, one after the other, without padding."""
    for name in records.dtype.names or ():
        yield np.ascontiguousarray(records[name])
