"""`RouteBook` and `StopBook`: routes and stops of SUMO's vehicles, stored while worlds run.

Routes are stored at the end of the table of the steps of all routes. A *way* is the offset of a
route in that table, as in VEHICLE["way"].
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

MAX_WAY_STEPS = 8_000_000  # limit for all worlds; memory is used only when it is written


class RouteBook:
    """The paths of W worlds; a path is a route together with the lanes that vehicles may use.

    `steps`: PLAN, the table of all steps. `first`: start of the room for these worlds, at the end
    of the table. `permissions`: (num_types,) permissions of VTYPE rows. `plan_steps`: number of
    steps of each world's own plans, which precede the room.
    """

    def __init__(
        self,
        network: RoadNetwork,
        steps: NDArray[np.void],
        first: int,
        num_worlds: int,
        permissions: NDArray[np.uint32],
        plan_steps: int = 0,
    ) -> None:
        self._network = network
        self._steps = steps
        lanes = len(network.lanes)
        nowhere = steps[first : first + lanes]
        nowhere["next"] = nowhere["link"] = -1
        nowhere["to_go"] = np.inf
        self._nowhere = first
        # A way is the row of a step minus the row of a lane. Unused steps before the first step
        # keep the ways of these worlds greater than all other ways.
        self._first = first + 2 * lanes
        self._of_world = (len(steps) - self._first) // num_worlds
        self._masks, self._class_of_type = np.unique(permissions, return_inverse=True)
        self._worlds = [_Pages(self._first + w * self._of_world) for w in range(num_worlds)]
        # In an environment with one world, the room would begin this many steps earlier.
        self._later = (num_worlds - 1) * plan_steps

    @staticmethod
    def room(network: RoadNetwork, num_worlds: int) -> int:
        lanes = len(network.lanes)
        return 2 * lanes + min(num_worlds * (64 * lanes + 100_000), MAX_WAY_STEPS)

    def begin(self, w: int) -> None:
        self._worlds[w] = _Pages(self._first + w * self._of_world)

    def paths(self, w: int) -> Paths:
        return self._worlds[w].arrays(self._nowhere)

    def single(self, rows: NDArray[np.void], w: int) -> None:
        """Convert ways of world w's VEHICLE or DEPARTURE rows to an environment with one world."""
        own = rows["way"] >= self._first - len(self._network.lanes)
        of_book = rows["way"] >= self._nowhere
        rows["way"] -= own * (w * self._of_world) + of_book * self._later

    def placed(self, rows: NDArray[np.void], w: int) -> None:
        """Convert the ways of rows back to ways in world w; see `single`."""
        own = rows["way"] >= self._first - self._later - len(self._network.lanes)
        of_book = rows["way"] >= self._nowhere - self._later
        rows["way"] += own * (w * self._of_world) + of_book * self._later

    def enter(self, w: int, routes: list[list[int]]) -> None:
        """Add routes that SUMO has reported, each given as EDGE rows; number them in this order."""
        self._worlds[w].routes += [np.array(edges, dtype=np.int32) for edges in routes]

    def look_up(
        self, w: int, routes: NDArray[np.int32], vtypes: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Return the paths (n,) of vehicles with VTYPE rows (n,) on routes (n,).

        Raises CapacityError: there is no room for more paths.
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
        # If this map lacks edges of a route, vehicles drive on the remaining edges.
        num_lanes = np.where(edges >= 0, rows["num_lanes"][edges], 0)
        first_lane = np.where(edges >= 0, rows["first_lane"][edges], 0)
        begin = pages.end
        offsets = np.cumsum(num_lanes) - num_lanes
        pages.end += int(num_lanes.sum())
        if pages.end > pages.begin + self._of_world:
            raise CapacityError(
                f"SUMO's routes have over {self._of_world} steps in one world; use fewer worlds, "
                "or demand with fewer different routes"
            )
        for piece in np.split(np.arange(len(edges)), np.flatnonzero(edges < 0)):
            part = edges[piece][edges[piece] >= 0]
            if len(part):
                place = begin + int(offsets[piece[edges[piece] >= 0][0]])
                steps = self._steps[place : place + int(rows["num_lanes"][part].sum())]
                plan_route(self._network.arrays, part, mask, 0, steps, np.zeros(len(steps)))
        return pages.add(edges, mask, begin + offsets - first_lane)


class _Pages:
    """The routes and paths of one world.

    Attributes:
        begin: first step of the world.
        end: end of the steps in use.
        routes: EDGE rows of each route, by SUMO's number.
        path_of: path by route and class, or -1.
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
        """Add a path and return its number."""
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
    """Return the array; if it is too short, return a copy of length 2 * `wanted`."""
    if wanted <= len(array):
        return array
    larger = np.zeros(2 * wanted, dtype=array.dtype)
    larger[:used] = array[:used]
    return larger


MAX_STOPS = 2_000_000  # limit for all worlds; memory is used only when it is written
OF_WORLD = 200_000

ReportedStop = tuple[int, float, float, float, float, bool]
"""A stop as SUMO reports it: LANE row; start and end in m on SUMO's lane; duration and until in s,
or -1; whether the vehicle parks beside the road."""


class StopRange(NamedTuple):
    """STOP rows [first, end) of a vehicle; (-1, -1): no stops."""

    first: int
    end: int


NO_STOPS = StopRange(-1, -1)


class StopBook:
    """The stops of W worlds; equal lists of stops in a world are stored once.

    `table`: STOP of all worlds.
    """

    def __init__(self, network: RoadNetwork, table: NDArray[np.void], num_worlds: int) -> None:
        lanes = network.lanes
        # The length attribute of SUMO's lanes may differ from the length of their polyline.
        self._scale = lanes["length_m"] / network.edges["length_m"][lanes["edge"]]
        self._table = table
        self._of_world = len(table) // num_worlds
        self._ends = [w * self._of_world for w in range(num_worlds)]
        self._known: list[dict[tuple[ReportedStop, ...], StopRange]] = [
            {} for _ in range(num_worlds)
        ]

    @staticmethod
    def room(num_worlds: int) -> int:
        return min(num_worlds * OF_WORLD, MAX_STOPS)

    def begin(self, w: int) -> None:
        self._ends[w] = w * self._of_world
        self._known[w] = {}

    def enter(self, w: int, stops: Sequence[Sequence[float]]) -> StopRange:
        """Return the range of a vehicle's stops in the table; new stops are written.

        `stops`: a `ReportedStop` per stop, in the order of the vehicle's route.

        Raises CapacityError: there is no room for more stops.
        """
        if not stops:
            return NO_STOPS
        reported = tuple(_checked(stop) for stop in stops)
        found = self._known[w].get(reported)
        if found is None:
            found = self._known[w][reported] = self._write(w, reported)
        return found

    def _write(self, w: int, reported: tuple[ReportedStop, ...]) -> StopRange:
        first = self._ends[w]
        end = first + len(reported)
        if end > (w + 1) * self._of_world:
            raise CapacityError(
                f"SUMO's vehicles make over {self._of_world} stops in one world; use fewer "
                "worlds, or a shorter horizon_s"
            )
        rows = np.zeros(len(reported), dtype=STOP)
        for row, (lane, start, stop_end, duration_s, until_s, parking) in zip(
            rows, reported, strict=True
        ):
            row["lane"], row["at_edge"] = lane, -1
            row["start"], row["end"] = start * self._scale[lane], stop_end * self._scale[lane]
            row["duration"], row["until"] = max(duration_s, 0.0), until_s
            row["until_from"], row["parking"] = UNTIL_ABSOLUTE, parking
        self._table[first:end] = rows
        self._ends[w] = end
        return StopRange(first, end)

    def shift(self, rows: NDArray[np.void], worlds: int) -> None:
        """Convert the stops of world w's VEHICLE or DEPARTURE rows to world w + `worlds`."""
        has_some = rows["stop"] >= 0
        for name in ("stop", "stops_end"):
            rows[name] += has_some * (worlds * self._of_world)


def _checked(stop: Sequence[float]) -> ReportedStop:
    lane, start, end, duration_s, until_s, parking = stop
    return int(lane), start, end, duration_s, until_s, bool(parking)
