"""`RouteBook` and `StopBook`: routes and stops of SUMO's vehicles, written while worlds run.

Routes are ways, behind the table of all ways.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CapacityError
from cavmarl.roads.kernels.route_steps import plan_route
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.demand.demand_records import STOP, UNTIL_ABSOLUTE
from cavmarl.traffic.kernels.mirroring import Paths

MAX_WAY_STEPS = 8_000_000  # of all worlds; memory that is never written is never taken


class RouteBook:
    """The paths of W worlds, each a route as vehicles with certain permissions can drive it.

    `steps`: PLAN, the table of all ways. `first`: where in it these worlds' room begins; behind it
    is nothing else. `permissions`: (num_types,) of VTYPE rows.
    """

    def __init__(
        self,
        network: RoadNetwork,
        steps: NDArray[np.void],
        first: int,
        num_worlds: int,
        permissions: NDArray[np.uint32],
    ) -> None:
        self._network = network
        self._steps = steps
        lanes = len(network.lanes)
        nowhere = steps[first : first + lanes]
        nowhere["next"] = nowhere["link"] = -1
        nowhere["to_go"] = np.inf
        self._nowhere = first
        # So many unused steps keep the ways of each world above all others: a way is a step's row
        # minus that of a lane.
        self._first = first + 2 * lanes
        self._of_world = (len(steps) - self._first) // num_worlds
        self._masks, self._class_of_type = np.unique(permissions, return_inverse=True)
        self._worlds = [_Pages(self._first + w * self._of_world) for w in range(num_worlds)]

    @staticmethod
    def room(network: RoadNetwork, num_worlds: int) -> int:
        lanes = len(network.lanes)
        return 2 * lanes + min(num_worlds * (64 * lanes + 100_000), MAX_WAY_STEPS)

    def begin(self, w: int) -> None:
        self._worlds[w] = _Pages(self._first + w * self._of_world)

    def paths(self, w: int) -> Paths:
        return self._worlds[w].arrays(self._nowhere)

    def shift(self, rows: NDArray[np.void], worlds: int) -> None:
        """Let rows, VEHICLE or departures, mean the ways of so many worlds later."""
        own = rows["way"] >= self._first - len(self._network.lanes)
        rows["way"] += own * (worlds * self._of_world)

    def enter(self, w: int, routes: list[list[int]]) -> None:
        """Take up routes that SUMO has told of, EDGE rows of each, numbered in this order."""
        self._worlds[w].routes += [np.array(edges, dtype=np.int32) for edges in routes]

    def look_up(
        self, w: int, routes: NDArray[np.int32], vtypes: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """The paths (n,) of vehicles of VTYPE rows (n,) on routes (n,).

        Raises CapacityError: there is no room for more.
        """
        pages, classes = self._worlds[w], len(self._masks)
        pairs = routes.astype(np.int64) * classes + self._class_of_type[vtypes]
        missing = len(pages.routes) * classes - len(pages.path_of)
        if missing > 0:
            pages.path_of = np.append(pages.path_of, np.full(missing, -1, dtype=np.int32))
        for pair in np.unique(pairs[pages.path_of[pairs] < 0]).tolist():
            route, mask = divmod(pair, classes)
            pages.path_of[pair] = self._plan(pages, pages.routes[route], int(self._masks[mask]))
        found: NDArray[np.int32] = pages.path_of[pairs]
        return found

    def _plan(self, pages: _Pages, edges: NDArray[np.int32], mask: int) -> int:
        known = pages.known.get((edges.tobytes(), mask))
        if known is not None:
            return known
        rows = self._network.edges
        # A route over edges that this map has left out is driven where it is on the map.
        num_lanes = np.where(edges >= 0, rows["num_lanes"][edges], 0)
        first_lane = np.where(edges >= 0, rows["first_lane"][edges], 0)
        begin = pages.end
        offsets = np.cumsum(num_lanes) - num_lanes
        pages.end += int(num_lanes.sum())
        if pages.end > pages.begin + self._of_world:
            raise CapacityError(
                f"SUMO's routes have over {self._of_world} steps in one world: fewer worlds, or "
                "demand with fewer different routes"
            )
        for piece in np.split(np.arange(len(edges)), np.flatnonzero(edges < 0)):
            part = edges[piece][edges[piece] >= 0]
            if len(part):
                place = begin + int(offsets[piece[edges[piece] >= 0][0]])
                steps = self._steps[place : place + int(rows["num_lanes"][part].sum())]
                plan_route(self._network.arrays, part, mask, 0, steps, np.zeros(len(steps)))
        return pages.add(edges, mask, begin + offsets - first_lane)


class _Pages:
    """What is known of one world's routes.

    Attributes:
        begin: of its steps.
        end: of those in use.
        routes: EDGE rows of each, by SUMO's number.
        path_of: by route and class, or -1.
        known: paths by edges and permissions.
    """

    def __init__(self, begin: int) -> None:
        self.begin = self.end = begin
        self.routes: list[NDArray[np.int32]] = []
        self.path_of = np.zeros(0, dtype=np.int32)
        self.known: dict[tuple[bytes, int], int] = {}
        self._num = 0
        self._first = np.zeros(1, dtype=np.int64)
        self._edges = np.zeros(0, dtype=np.int32)
        self._ways = np.zeros(0, dtype=np.int64)

    def add(self, edges: NDArray[np.int32], mask: int, ways: NDArray[np.int64]) -> int:
        """A new path's number."""
        number = self.known[edges.tobytes(), mask] = self._num
        begin = int(self._first[number])
        end = begin + len(edges)
        self._first = _with_room(self._first, number + 1, number + 2)
        self._edges = _with_room(self._edges, begin, end)
        self._ways = _with_room(self._ways, begin, end)
        self._first[number + 1] = end
        self._edges[begin:end] = edges
        self._ways[begin:end] = ways
        self._num += 1
        return number

    def arrays(self, nowhere: int) -> Paths:
        end = int(self._first[self._num])
        return Paths(self._first[: self._num + 1], self._edges[:end], self._ways[:end], nowhere)


def _with_room(array: NDArray[Any], used: int, wanted: int) -> NDArray[Any]:
    """The same array, or one of twice the room with what is used: paths come one by one."""
    if wanted <= len(array):
        return array
    larger = np.zeros(2 * wanted, dtype=array.dtype)
    larger[:used] = array[:used]
    return larger


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

        Raises CapacityError: there is no room for more.
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
